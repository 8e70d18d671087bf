"""Cost of one's own: kick to a target, and gently. A cost is a named residual, a norm and a weight.

The residual gets one candidate: states (H', L, 13) of the scene, controls (H, J, 3) [rad] and the task's context; it
returns a vector, or one for each instant. All is JAX, so that the planner may differentiate it.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from mpc import CostTerm, quadratic
from tasks.kick import Kick
from tasks.session import Session

TARGET = (4.0, 0.5, 0.4)


class Gentle(Kick):
    """Kick whose ball should leave at `speed` [m/s]."""

    name = "gentle"
    speed = 10.0

    @property
    def costs(self) -> tuple[CostTerm, ...]:
        """Return a term for the ball's highest speed."""

        def pace(states: Array, controls: Array, context: Any) -> Array:
            speeds = jnp.linalg.norm(states[:, self.ball, packed.VELOCITY], axis=-1)
            return jnp.max(speeds, keepdims=True) - self.speed

        return (CostTerm("pace", pace, quadratic, weight=0.5),)


def main() -> None:
    """Kick to the same target with and without the cost."""
    usual, gentle = (Session(task.standard()).run(TARGET, "fast") for task in (Kick, Gentle))
    for what, run in (("as it comes", usual), ("gently", gentle)):
        speed = run.summary["ball_speed_m_s"]
        print(f"{what}: {speed:.1f} m/s, missed by {100 * run.truth_error_m:.1f} cm")
    assert gentle.summary["ball_speed_m_s"] < usual.summary["ball_speed_m_s"] - 1.0
    assert gentle.truth_error_m < 0.3


if __name__ == "__main__":
    main()
