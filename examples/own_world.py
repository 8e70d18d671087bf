"""World of one's own to execute plans in: here the simulator in a side wind; it could be a robot.

A world has `reset(states)` and `step(control) -> states`: states (1, L, 13) of the whole scene, see `larp_model.state`;
joint targets (1, J, 3), rotation vectors [rad]; a step lasts `scene.dt`, 10 ms. `reset` may move a robot to where it
starts, or refuse; `step` sends the targets, waits for the step's end and returns what was sensed; NaN if all is lost.
"""

import jax.numpy as jnp
import numpy as np

from larp_model import Simulator
from larp_model import state as packed
from tasks.kick import Kick
from tasks.session import Session

TARGET = (4.0, 0.0, 0.5)
# Acceleration of a flying ball [m/s^2]: wind from the right at some 8 m/s.
WIND = np.array([0.0, 3.0, 0.0])


class Windy:
    """Simulator of the human and the ball, with wind."""

    def __init__(self, kick: Kick) -> None:
        self.simulator = Simulator.of_physics(kick.scene)
        self.dt, self.ball, self.radius = kick.scene.dt, kick.ball, kick.scene.links[kick.ball].radius

    def reset(self, states: np.ndarray) -> None:
        """Put the world into states (1, L, 13)."""
        self.states = np.asarray(states, np.float32)

    def step(self, control: np.ndarray) -> np.ndarray:
        """Return states (1, L, 13) after a step under joint targets (1, J, 3) [rad], with wind on a flying ball."""
        states, targets = jnp.asarray(self.states), jnp.asarray(control, jnp.float32)
        self.states = np.array(self.simulator.step(states, targets))
        if self.states[0, self.ball, 2] > self.radius + 0.01:
            self.states[:, self.ball, packed.VELOCITY] += self.dt * WIND
            self.states[:, self.ball, packed.POSITION] += 0.5 * self.dt**2 * WIND
        return self.states


def main() -> None:
    """Kick with a planner that ignores the wind, and miss to the left: see `own_model.py`."""
    kick = Kick.standard()
    run = Session(kick).run(TARGET, "fast", world=Windy(kick))
    aside = run.states[:, kick.ball, 1].max()
    print(f"blown {aside:.2f} m to the left, missed by {100 * run.truth_error_m:.1f} cm")
    assert run.summary["touched"] and 0.05 < run.truth_error_m < 1.0


if __name__ == "__main__":
    main()
