"""What is learned: networks that correct physics, and the paper's."""
