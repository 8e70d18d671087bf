"""Tasks and their commands: kicks, standing, motion from keypoints, training data and training."""
