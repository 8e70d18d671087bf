"""World that keeps its own time, as a robot does: it goes on, by the clock, while plans are made in a thread.

Observations come with the number of the step that they are of. Here it is the world of `own_world.py`.
"""

import queue
import threading
import time

import numpy as np
from own_world import TARGET, Windy

from mpc.realtime import PlanningThread, SimulatedLatency
from tasks.kick import Kick
from tasks.session import Session

PACE = 3.0  # a step takes three times as long as it lasts: slow motion, for machines that have other things to do


class Clocked:
    """World that steps by the clock, in a thread, under the latest joint targets."""

    def __init__(self, world: Windy, dt: float) -> None:
        self.world, self.dt = world, dt

    def reset(self, states: np.ndarray) -> None:
        """Begin in states (1, L, 13); the clock runs from the first joint targets on."""
        self.world.reset(states)
        self.seen, self.observations = 0, queue.SimpleQueue[tuple[int, np.ndarray]]()

    def step(self, control: np.ndarray) -> np.ndarray:
        """Send joint targets (1, J, 3) [rad]; return the latest states (1, L, 13), of a later step than the last."""
        self.targets = control
        if self.seen == 0:
            threading.Thread(target=self.run).start()
        arrived = [self.observations.get(timeout=10.0) for _ in range(max(1, self.observations.qsize()))]
        self.seen, states = arrived[-1]
        return states

    def run(self) -> None:
        """Step until nobody has looked for 50 steps."""
        begin, number = time.monotonic(), 0
        while number < self.seen + 50:
            time.sleep(max(0.0, begin + PACE * self.dt * (number + 1) - time.monotonic()))
            states, number = self.world.step(self.targets).copy(), number + 1
            self.observations.put((number, states))


def main() -> None:
    """Kick with plans that are made beside the world."""
    kick = Kick.standard()
    session, world = Session(kick), Clocked(Windy(kick), kick.scene.dt)
    session.run(TARGET, "fast", world=world.world, latency=SimulatedLatency(world.dt, 0.05))  # compiles
    run = session.run(TARGET, "fast", world=world, latency=PlanningThread(world.dt, 0.05 / PACE))
    print(f"missed by {100 * run.truth_error_m:.1f} cm; {world.seen - len(run.execution.controls)} steps were not seen")
    assert run.summary["touched"] and run.truth_error_m < 1.0


if __name__ == "__main__":
    main()
