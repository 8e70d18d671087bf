"""Ground-truth episodes that models are trained on and judged by."""
