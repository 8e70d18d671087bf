"""Launches: error of the velocity of a struck ball after the contact, by kinds of contact.

The ball is the second body of the scene's first pair, if that is a single link.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.detection import contact_points, first_contacts
from larp_model.errors import InputError
from larp_model.prediction import predict
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.state import Trajectories

# The launch is read this many steps after first contact, of balls faster than this [m/s].
STEPS, SLOWEST = 8, 1.5
# A link touches where its gap within a step is smaller [m], a ball lies on the ground where it is no higher above [m].
TOUCHING, LYING = 1e-3, 0.01
# A push changes the ball's velocity in a step by more than gravity and rolling do [m/s].
PUSH = 0.3
# Bounds of the classes of speed [m/s].
SPEEDS = (2.0, 9.0, 14.0)
# Sides, which are not distinguished: a link strikes much as its mirror image does.
SIDES = ("left_", "right_")
# Steps of one call of the compiled program.
CHUNK = 1024


class Launches(NamedTuple):
    """N launches in the ground truth, and the errors of their prediction.

    error: (N,) |v - v'| / |v|, inf where the prediction diverged. angle: (N,) between v and v' [degrees]. speed: (N,)
    of the ball [m/s]. lying: (N,) whether it lay on the ground. steps: (N,) in which it was pushed. by: mask (N, P) of
    the links that touched it, of those that can, whose names are `links`.
    """

    error: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    lying: np.ndarray
    steps: np.ndarray
    by: np.ndarray
    links: tuple[str, ...]

    @property
    def kinds(self) -> dict[str, np.ndarray]:
        """Return a mask (N,) of the launches of every kind, by its name; empty kinds are left out."""
        slow, medium, fast = SPEEDS
        several, groups = self.by.sum(axis=1) > 1, [_without_side(link) for link in self.links]
        alone = {
            f"by the {group}": ~several & self.by[:, [other == group for other in groups]].any(axis=1)
            for group in dict.fromkeys(groups)
        }
        pushed = (self.steps >= 3) | several | alone.get("by the shin", np.zeros(len(self.error), bool))
        kinds = {
            "ball on the ground": self.lying,
            "ball in the air": ~self.lying,
            f"below {slow:g} m/s": self.speed < slow,
            f"{slow:g} to {medium:g} m/s": (self.speed >= slow) & (self.speed < medium),
            f"{medium:g} to {fast:g} m/s": (self.speed >= medium) & (self.speed < fast),
            f"above {fast:g} m/s": self.speed >= fast,
            "one step": self.steps <= 1,
            "two steps": self.steps == 2,
            "three steps and more": self.steps >= 3,
            **alone,
            "by several links": several,
            # Slow and long contacts, shins, several links: frequent in plans, and rare in random kicks.
            "pushes": (self.speed >= slow) & (self.speed < medium) & pushed,
        }
        return {name: which for name, which in kinds.items() if which.any()}

    @property
    def summary(self) -> dict[str, Any]:
        """Return count and quantiles of both errors, of all launches and, under `kinds`, of every kind."""
        return self.figures(np.ones(len(self.error), bool)) | {
            "kinds": {name: self.figures(which) for name, which in self.kinds.items()}
        }

    def figures(self, which: np.ndarray) -> dict[str, Any]:
        """Return count and quantiles of both errors of the launches in a mask (N,)."""
        if not which.any():
            return {"count": 0}
        return {
            "count": int(which.sum()),
            "relative_error": quantiles(self.error[which]),
            "angle_deg": quantiles(self.angle[which]),
        }


def launches_of(simulator: Simulator, episodes: Trajectories, before: int) -> Launches:
    """Return the launches of episodes, predicted from the true states `before` steps ahead of first contact."""
    scene, row = simulator.scene, struck(simulator.scene)
    if row is None:
        raise InputError("simulator.scene has no body of one link that another can strike")
    contacts = first_contacts(scene.between, episodes)
    rows = np.flatnonzero((contacts >= before) & (contacts + STEPS <= episodes.controls.shape[1]))
    rows = rows[_speed(episodes.states[rows, contacts[rows] + STEPS, row]) > SLOWEST]
    during = episodes.states[rows[:, None], contacts[rows][:, None] + np.arange(STEPS + 1)]
    touched, links = _touched(scene, during, episodes.morphology[rows])
    true, size = during[:, -1, row, packed.VELOCITY], _speed(during[:, -1, row])
    if len(rows):
        start, columns = contacts[rows] - before, contacts[rows][:, None] - before + np.arange(before + STEPS)
        predicted = predict(
            simulator, episodes.states[rows, start], episodes.controls[rows[:, None], columns],
            episodes.torques[rows[:, None], columns], episodes.morphology[rows],
        )[:, -1, row, packed.VELOCITY]  # fmt: skip
    else:
        predicted = true
    error = np.linalg.norm(predicted - true, axis=-1) / size
    cosine = np.sum(predicted * true, axis=-1) / np.maximum(size * np.linalg.norm(predicted, axis=-1), 1e-9)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    diverged = ~np.isfinite(error)
    return Launches(
        error=np.where(diverged, np.inf, error),
        angle=np.where(diverged, 180.0, angle),
        speed=size,
        lying=during[:, 0, row, 2] < episodes.morphology[rows, row, 1] + LYING,
        steps=touched.any(axis=2).sum(axis=1),
        by=np.asarray(touched.any(axis=1)),
        links=links,
    )


def struck(scene: Scene) -> int | None:
    """Return the row of the ball; None where the scene has none: see the module."""
    for pair in scene.between.pairs[:1]:
        if len(scene.body(pair.second).links) == 1:
            return scene.index(pair.second, pair.second_links[0])
    return None


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Return median, 75th and 90th percentile; of values that may be infinite, none is taken between two."""
    method: Literal["linear", "higher"] = "linear" if np.isfinite(values).all() else "higher"
    levels = {"median": 0.5, "p75": 0.75, "p90": 0.9}
    return {name: float(np.quantile(values, level, method=method)) for name, level in levels.items()}


def _touched(scene: Scene, states: np.ndarray, morphology: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return masks (N, T, P) of links that push the ball in steps of states (N, T + 1, L, 13), and their names."""
    count, steps = len(states), states.shape[1] - 1
    before, after = (states[:, ends].reshape(-1, *states.shape[2:]) for ends in (slice(-1), slice(1, None)))
    sizes, parts = np.repeat(morphology, steps, axis=0), []
    for begin in range(0, len(before), CHUNK):
        rows = np.minimum(np.arange(begin, begin + CHUNK), len(before) - 1)
        parts.append(np.asarray(_pushes(scene, before[rows], after[rows], sizes[rows])))
    links = scene.between.pairs[0].first_links
    return np.concatenate([*parts, np.zeros((0, len(links)), bool)])[: len(before)].reshape(count, steps, -1), links


@partial(jax.jit, static_argnums=0)
def _pushes(scene: Scene, before: Array, after: Array, morphology: Array) -> Array:
    """Return a mask (B, P) of the links that touch the ball, and push it, between states (B, L, 13)."""
    alone = replace(scene, pairs=scene.between.pairs[:1])
    ((pair, points),) = contact_points(alone, before, morphology, after)
    ball = scene.index(pair.second, pair.second_links[0])
    free = jnp.array([0.0, 0.0, -scene.gravity * scene.dt], before.dtype)
    change = packed.velocity(after)[:, ball] - packed.velocity(before)[:, ball] - free
    pushes: Array = (points.lowest < TOUCHING) & (jnp.linalg.norm(change, axis=-1) > PUSH)[:, None]
    return pushes


def _without_side(link: str) -> str:
    return next((link.removeprefix(side) for side in SIDES if link.startswith(side)), link)


def _speed(links: np.ndarray) -> np.ndarray:
    speed: np.ndarray = np.linalg.norm(links[..., packed.VELOCITY], axis=-1)
    return speed
