"""Pass the ball along the ground to a team mate who runs: a task of one's own, from outside the package.

    minimise over theta   w_t |x_b(t*) - m(t*)|                 the ball meets the mate, who is at m(t) = p + v t
                        + w_l mean_t max(0, z_b(t) - h)^2       and stays low
                        + ...                                   near the reference: see tasks.task

t* is the time at which ball and mate are nearest, between steps too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from mpc import CostTerm, nearest_on_path
from tasks.session import Session
from tasks.task import Task, check_target

RADIUS, LOW = 0.11, 0.5  # m


class Runner(NamedTuple):
    """Position (3,) [m] of a team mate when the kick begins, and velocity (3,) [m/s]."""

    position: np.ndarray
    velocity: np.ndarray


class Pass(Task):
    """Pass to a `Runner`."""

    name = "pass"

    def check(self, goal: Runner) -> Runner:
        """See `Task`."""
        return Runner(*(check_target(vector) for vector in goal))

    def miss(self, states: Any, times: Any, goal: Runner) -> Any:
        """See `Task`."""
        mate = goal.position + goal.velocity * times[:, None]
        return nearest_on_path(states[:, self.ball, packed.POSITION] - mate, np.zeros(3))[0]

    def marker(self, goal: Runner) -> np.ndarray:
        """See `Task`."""
        return goal.position

    @property
    def costs(self) -> tuple[CostTerm, ...]:
        """See `Task`."""
        return (CostTerm("low", self.height, weight=10.0),)

    def height(self, states: Array, controls: Array, context: Any) -> Array:
        """Return the ball's height above `LOW`, (H', 1) [m]."""
        return jnp.maximum(states[:, self.ball, 2:3] - LOW, 0.0)

    def metrics(self, states: np.ndarray, goal: Runner) -> dict[str, float]:
        """See `Task`."""
        return {"highest_m": float(states[:, self.ball, 2].max())}


def runners(count: int, seed: int) -> list[Runner]:
    """Return team mates 4 to 6 m away who run at up to 3 m/s."""
    random, mates = np.random.default_rng(seed), []
    for _ in range(count):
        bearing, heading = np.radians(random.uniform(-20.0, 20.0)), random.uniform(-np.pi, np.pi)
        distance, speed = random.uniform(4.0, 6.0), random.uniform(0.0, 3.0)
        position = np.array([distance * np.cos(bearing), distance * np.sin(bearing), RADIUS])
        mates.append(Runner(position, speed * np.array([np.cos(heading), np.sin(heading), 0.0])))
    return mates


def main(count: int = 16) -> None:
    """Pass to so many runners; three of four passes reach theirs within 0.3 m."""
    session, reached = Session(Pass.standard()), 0
    for seed, runner in enumerate(runners(count, seed=3)):
        run = session.run(runner, "fast", seed)
        reached += run.truth_error_m < 0.3
        print(f"{session.task.title(runner)}: missed by {100 * run.truth_error_m:.0f} cm")
    run.save("runs/pass")
    print(f"{reached} of {count} within 0.3 m")
    assert reached >= 0.75 * count


if __name__ == "__main__":
    main()
