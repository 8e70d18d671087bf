"""Benchmarks of the simulator, the planner, reconstruction of motion from keypoints, and the web page."""
