"""Tracking of a long motion by the human of a simulator, planned and executed in that simulator alone, as in the paper.

The motion is one of squats with the arms swinging, which keeps both feet where they are: who follows it has to stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.evaluation import DIVERGED, by_window, mean
from larp_model.physics import kinematics
from larp_model.scene import Body, Scene
from larp_model.simulator import Simulator
from mpc import CEM
from mpc.loop import DivergenceError
from tasks.motions import references, styles
from tasks.motions.tracking import Tracker

# Time of a squat [s], and depth of the deepest [rad]: of thighs, with twice as much of shins.
PERIOD, DEPTH = 3.0, 0.7
# Shares of the depth by which links turn about y, and swing of the arms [rad].
BENDS = {"thigh": -1.0, "shin": 2.0, "foot": -1.0}
LEAN, SWING = 0.4, 0.5
# Who looks ahead for half of this falls within 5 s.
HORIZON, OPTIMIZER = 60, CEM(samples=128, rounds=3, elites=12)


class SimulatedWorld:
    """World of one simulation by a simulator; see `mpc.loop.World`. states: (T + 1, L, 13), all so far."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.states: list[np.ndarray] = []

    def reset(self, states: np.ndarray) -> None:
        """See `mpc.loop.World`."""
        self.states = [np.asarray(states[0], np.float32)]

    def step(self, control: np.ndarray) -> np.ndarray:
        """See `mpc.loop.World`."""
        state = np.asarray(self.simulator.step(self.states[-1][None], np.asarray(control, np.float32)))
        if not packed.healthy(state)[0] or np.abs(state[..., packed.POSITION]).max() > DIVERGED:
            return np.full_like(state, np.nan)
        self.states.append(state[0])
        return state


def squats(human: Body, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (steps, J, 3) [rad] of squats, one every `PERIOD`."""
    rows, phase = styles.rows_of(human), 2.0 * np.pi * np.arange(steps) * dt / PERIOD
    targets, depth = np.zeros((steps, len(rows), 3)), 0.5 * DEPTH * (1.0 - np.cos(phase))
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        for segment, share in BENDS.items():
            targets[:, rows[f"{side}_{segment}"], 1] = share * depth
        targets[:, rows[f"{side}_upper_arm"], 1] = sign * SWING * np.sin(phase)
    targets[:, rows["torso"], 1] = LEAN * depth
    return np.clip(targets, *human.limits)


def tracked(simulator: Simulator, windows: Sequence[int]) -> dict[str, Any]:
    """Return errors over the first n steps, n in `windows`, of the simulator's human who tracks `squats`.

    As of `evaluation.evaluate`, for one sequence: distance [m] of links from the motion, None in windows within which
    the simulation diverges; mean displacement of joints [m] as far as it goes.
    """
    scene, steps = simulator.scene, max(windows)
    controls = squats(scene.human, steps, scene.dt)
    target_states = references.standing_on_ground(scene, controls, Rotation.identity(steps))
    world = SimulatedWorld(simulator)
    weights = np.ones((steps, len(scene.links)))
    try:
        tracker = Tracker(scene, target_states, weights, controls, simulator, HORIZON, OPTIMIZER)
        tracker.follow(target_states[0], 0, steps, world)
    except DivergenceError:
        pass  # the states so far are those of the world
    return errors(scene, np.array(world.states)[1:], target_states, np.asarray(simulator.morphology), windows)


def errors(
    scene: Scene, states: np.ndarray, target_states: np.ndarray, morphology: np.ndarray, windows: Sequence[int]
) -> dict[str, Any]:
    """Return what `tracked` does, of states (T, L, 13) beside those of the motion; T is less or 0 if they diverged."""
    steps = len(states)
    distance = np.linalg.norm((states - target_states[:steps])[..., packed.POSITION], axis=-1)
    known, lost = [n for n in windows if n <= steps], [n for n in windows if n > steps]
    nothing = {body.name: None for body in scene.bodies}
    apart = kinematics.displacement(scene, jnp.asarray(states), jnp.asarray(morphology)[None])
    return {
        "windows": by_window(scene, distance[None], known) | {str(n): nothing for n in lost},
        "displacement_m": mean(jnp.linalg.norm(apart, axis=-1)),
        "sequences": 1,
        "diverged": int(bool(lost)),
    }
