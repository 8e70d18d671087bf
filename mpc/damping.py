"""Damping of Levenberg and Marquardt's steps, from one to the next (D. Marquardt 1963)."""

# A step that gains more, or less, of what its quadratic predicts divides, or multiplies, the next damping, down to a
# floor; after a step that gains nothing it is ten times as large.
GOOD_SHARE, BAD_SHARE, FACTOR, FAILURE_FACTOR, LEAST = 0.75, 0.25, 3.0, 10.0, 1e-6


def next_damping(damping: float, gain: float, predicted_gain: float) -> float:
    """Return the damping after a step that lowered the cost by `gain`; it is taken where that is above 0.

    damping: of the step. predicted_gain: by how much the step's quadratic model of the cost expected it to be lowered.
    """
    if not gain > 0.0:
        return FAILURE_FACTOR * damping
    if gain < BAD_SHARE * predicted_gain:
        return FACTOR * damping
    return max(damping / FACTOR, LEAST) if gain > GOOD_SHARE * predicted_gain else damping
