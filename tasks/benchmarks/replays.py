"""Open-loop replays of executed kicks: errors of engines against MuJoCo with small, converged steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import chain
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.scene import Scene
from tasks.benchmarks import report
from tasks.benchmarks.engines import STEPPED, TRACED
from tasks.gap import LAUNCH_STEPS
from tasks.presets import PresetName
from tasks.session import HOLD_STEPS, Session
from tasks.strike import strike_step

# MuJoCo's limit: engine steps in a step at which it is the reference for all others.
LIMIT = 160
# Steps after the reference's strike within which the ball passes its target.
AFTER_STRIKE = 150
# Steps before contact from which a launch is replayed.
BEFORE_CONTACT = 3

# States (1, L, 13) and joint targets (1, H, J, 3) [rad] -> position and velocity (H, 6) [m, m/s] of the ball.
Player = Callable[[np.ndarray, np.ndarray], np.ndarray]
Engine = tuple[str, int]


class Kicked(NamedTuple):
    """An executed kick: its target (3,) [m], its start (L, 13) and the joint targets (T, J, 3) [rad] of every step."""

    target: np.ndarray
    start: np.ndarray
    controls: np.ndarray


def player_of(scene: Scene, engine: str, substeps: int) -> Player:
    """Return a function that replays one kick in an engine."""
    if engine in STEPPED:
        truth = STEPPED[engine](scene, substeps, 1)

        def stepped(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
            return ball_of(truth.rollout(states, controls)[0][0])

        return stepped
    traced = TRACED[engine](scene, substeps)

    @jax.jit
    def roll(start: Any, controls: jax.Array) -> jax.Array:
        def step(carry: Any, control: jax.Array) -> tuple[Any, jax.Array]:
            after = traced.step(carry, control)
            return after, traced.ball(after)[0]

        return jax.lax.scan(step, traced.enter(start), controls[0][:, None])[1]

    def compiled(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        return np.asarray(roll(traced.start(states), jnp.asarray(controls, jnp.float32)))

    return compiled


def ball_of(states: np.ndarray) -> np.ndarray:
    """Return position and velocity (H, 6) [m, m/s] of the last link in states (H, L, 13)."""
    ball = states[:, -1]
    return np.concatenate([ball[:, packed.POSITION], ball[:, packed.VELOCITY]], axis=-1)


def executed(session: Session, preset: PresetName, target: np.ndarray, seed: int, shift: np.ndarray) -> Kicked:
    """Plan a kick and execute it in the ground truth until the ball is away; the reference's joint targets follow."""
    kick = session.task
    until = kick.reference.strike + HOLD_STEPS
    execution = session.execute(session.planners(preset), target, seed, kick.start(shift), until)
    _, after = kick.reference.window(until, AFTER_STRIKE - HOLD_STEPS)
    return Kicked(target, execution.states[0], np.concatenate([np.stack(execution.controls), after]))


def replay_errors(scene: Scene, kicked: Kicked, players: dict[Engine, Player]) -> list[report.Row]:
    """Return each engine's errors against MuJoCo's limit; no rows where the limit has no contact with the ball.

    Contact must come at least `BEFORE_CONTACT` steps after the start.
    error_m: distance of the balls when the limit's passes nearest to the target, replayed from the kick's start.
    launch_error: |v - v'| / |v|, `LAUNCH_STEPS` after contact, replayed from `BEFORE_CONTACT` steps before it.
    """
    start, controls = kicked.start[None], kicked.controls[None]
    limit = Truth(scene, 1, LIMIT, threads=1).rollout(start, controls)[0][0]
    states = np.concatenate([start, limit])
    contact = strike_step(states, states[:1, -1])
    if contact is None or contact < BEFORE_CONTACT:
        return []
    passing_step = contact + int(
        np.linalg.norm(states[contact:, -1, packed.POSITION] - kicked.target, axis=-1).argmin()
    )
    begin, launch = contact - BEFORE_CONTACT, contact + LAUNCH_STEPS
    place, velocity = states[passing_step, -1, packed.POSITION], states[launch, -1, packed.VELOCITY]
    rows = []
    for (engine, substeps), play in players.items():
        path = play(start, controls)
        launched = play(states[begin : begin + 1], controls[:, begin:launch])[-1, 3:]
        rows.append(
            {
                "engine": engine,
                "substeps": substeps,
                "error_m": float(np.linalg.norm(path[passing_step - 1, :3] - place)),
                "launch_error": float(np.linalg.norm(launched - velocity) / np.linalg.norm(velocity)),
            }
        )
    return rows


def figures_of(kicks: Iterable[list[report.Row]]) -> list[report.Row]:
    """Return each engine's errors over all kicks; None for what is not finite.

    A kick in which an engine diverged is left out of its mean, and counts as infinitely far off in its medians.
    """
    by_engine: dict[Engine, list[report.Row]] = {}
    for row in chain.from_iterable(kicks):
        by_engine.setdefault((row["engine"], row["substeps"]), []).append(row)
    summaries = []
    for (engine, substeps), rows in by_engine.items():
        errors = np.array([(row["error_m"], row["launch_error"]) for row in rows])
        is_finite = np.isfinite(errors).all(axis=1)
        errors[~is_finite] = np.inf
        median, launch = np.median(errors, axis=0)
        summaries.append(
            {
                "engine": engine,
                "substeps": substeps,
                "kicks": len(rows),
                "diverged": int((~is_finite).sum()),
                "mean_m": float(errors[is_finite, 0].mean()) if is_finite.any() else None,
                "median_m": float(median) if np.isfinite(median) else None,
                "launch_error": float(launch) if np.isfinite(launch) else None,
            }
        )
    return summaries
