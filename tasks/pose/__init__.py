"""Motion from 2D keypoints: detector files, cameras, kinematic start, physical fit and metrics."""
