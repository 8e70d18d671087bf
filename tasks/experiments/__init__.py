"""The paper's experiments, as lists of trainings, side by side with what the paper says of them."""
