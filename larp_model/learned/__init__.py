"""Models with networks: physics that they correct, and the paper's."""
