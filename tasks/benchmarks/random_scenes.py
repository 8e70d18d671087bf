"""Random scenes in random states, in MuJoCo and in the learned simulator."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import numpy as np

from larp_model import state as packed
from larp_model.anatomy import KINDS as HUMANS
from larp_model.anatomy import Detail
from larp_model.bodies import ball, capsule, chain, human, human_and_ball, kicking_links
from larp_model.engines.mujoco import Truth
from larp_model.physics import kinematics
from larp_model.scene import Pair, Scene
from larp_model.simulator import Simulator
from mpc import CostTerm, evaluate
from tasks.benchmarks.promises import row
from tasks.benchmarks.report import Row

KINDS = (
    "ball",
    "two balls",
    "capsule",
    "capsule and ball",
    "two capsules",
    "chain",
    "chain and ball",
    "human",
    "human and ball",
    "two humans",
    "human and capsule",
    "human whose legs can touch, and ball",
    "full human and ball",
)


def scene_of_kind(kind: str, random: np.random.Generator | None) -> Scene:
    """Return a scene of a kind with sizes from a tenth to ten times the usual, or the usual without a generator.

    A human's height [m] is between 0.3 and 3, and so are the factors of its segments' lengths and radii.
    """

    def size(usual: float) -> float:
        return usual if random is None else float(usual * 10.0 ** random.uniform(-1.0, 1.0))

    def person(name: str, detail: Detail = "lean") -> Any:
        if random is None:
            return human(name, detail=detail)
        segments = ("torso", "upper_arm", "thigh", "shin", "foot")
        lengths, radii = ({segment: float(random.uniform(0.3, 3.0)) for segment in segments} for _ in range(2))
        return human(name, float(random.uniform(0.3, 3.0)), size(70.0), lengths, radii, detail)

    def round_one(name: str) -> Any:
        return ball(name, size(0.11), size(0.43))

    bodies: dict[str, tuple[Any, ...]] = {
        "ball": (round_one("ball"),),
        "two balls": (round_one("first"), round_one("ball")),
        "capsule": (capsule("capsule", size(0.4), size(0.08), size(1.0)),),
        "capsule and ball": (capsule("capsule", size(0.4), size(0.08), size(1.0)), round_one("ball")),
        "two capsules": tuple(capsule(name, size(0.4), size(0.08), size(1.0)) for name in ("first", "capsule")),
        "chain": (chain("chain", 4, size(0.3), size(0.06), size(1.0)),),
        "chain and ball": (chain("chain", 4, size(0.3), size(0.06), size(1.0)), round_one("ball")),
        "human": (person("human"),),
        "human and ball": (person("human"), round_one("ball")),
        "two humans": (person("first"), person("human")),
        "human and capsule": (person("human"), capsule("capsule", size(0.4), size(0.08), size(1.0))),
        "human whose legs can touch, and ball": (person("human"), round_one("ball")),
        "full human and ball": (person("human", "full"), round_one("ball")),
    }
    chosen = bodies[kind]
    if len(chosen) == 1:
        return Scene(chosen)
    first, second = chosen
    first_links, second_links = (
        kicking_links(body) if body.kind in HUMANS.values() else tuple(link.name for link in body.links)
        for body in chosen
    )
    legs = human_and_ball(self_contact=True).within.pairs if "legs" in kind else ()
    return Scene(chosen, (Pair(first.name, second.name, first_links, second_links, ball().surface), *legs))


def random_states(scene: Scene, count: int, random: np.random.Generator) -> np.ndarray:
    """Return states (count, L, 13) of random orientations, speeds to 50 m/s and angular velocities to 200 rad/s.

    Links may be below ground, and in some states all are in one place.
    """
    states = np.zeros((count, len(scene.links), packed.SIZE))
    spread = 10.0 ** random.uniform(-3.0, 0.5, (count, 1, 1))
    states[..., packed.POSITION] = spread * random.standard_normal((count, len(scene.links), 3)) + (0.0, 0.0, 0.5)
    together = random.random(count) < 0.2
    states[together, :, packed.POSITION] = states[together, :1, packed.POSITION]
    turned = random.standard_normal((count, len(scene.links), 4))
    states[..., packed.ORIENTATION] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    for columns, most in ((packed.VELOCITY, 50.0), (packed.ANGULAR_VELOCITY, 200.0)):
        size = most * 10.0 ** random.uniform(-4.0, 0.0, (count, 1, 1))
        states[..., columns] = size * random.uniform(-1.0, 1.0, (count, len(scene.links), 3)) / np.sqrt(3.0)
    return states


class Tally(NamedTuple):
    """Counts of states and of failures, in random scenes of a kind."""

    states: int
    crashes: list[str]
    larp_lost: int  # not finite, and costs infinity
    truth_lost: int  # flagged as diverged
    silent: int  # not finite, but not flagged
    slowest: float  # s, of a scene in the engine


def random_scenes(kind: str, model: Simulator, scenes: int, states_per_scene: int, steps: int, seed: int) -> Tally:
    """Roll out random sizes and states of one kind of scene, in MuJoCo and in the learned simulator."""
    random = np.random.default_rng((seed, KINDS.index(kind)))
    crashes: list[str] = []
    truth_lost = silent = 0
    slowest = 0.0
    starts, targets, pushes, shapes = [], [], [], []
    for _ in range(scenes):
        scene = scene_of_kind(kind, random)
        state = random_states(scene, states_per_scene, random)
        lower, upper = scene.limits
        share = random.uniform(0.0, 1.0, (states_per_scene, steps, len(scene.motors), 3))
        control = 2.0 * (lower + share * (upper - lower))
        torque = (
            100.0
            * random.standard_normal((states_per_scene, 1, len(scene.links), 3))
            * (random.random((states_per_scene, 1, 1, 1)) < 0.2)
        )
        torque = np.repeat(torque, steps, axis=1)
        begin = time.monotonic()
        try:
            states, flags = Truth(scene, states_per_scene).rollout(state, control, torque)
            truth_lost += int((~flags).sum())
            silent += int((flags & ~np.isfinite(states).all(axis=(1, 2, 3))).sum())
        except Exception as error:
            crashes.append(f"MuJoCo: {type(error).__name__}: {error}")
        slowest = max(slowest, time.monotonic() - begin)
        starts.append(state)
        targets.append(control)
        pushes.append(torque)
        shapes.append(np.repeat(np.asarray(kinematics.morphology_of(scene))[None], states_per_scene, axis=0))
    larp_lost = 0
    size = CostTerm("size", lambda states, controls, context: states[:, :, 2])
    try:
        arguments = [np.concatenate(parts).astype(np.float32) for parts in (starts, targets, pushes, shapes)]
        run = jax.jit(lambda s, u, t, morphology: model.rollout(s, u, torques=t, morphology=morphology))
        after = run(*arguments)
        costs = jax.vmap(lambda s, u: evaluate([size], s, u)[0])(after, arguments[1])
        lost = ~np.isfinite(after).all(axis=(1, 2, 3))
        larp_lost = int(lost.sum())
        silent += int((lost & np.isfinite(costs)).sum())
    except Exception as error:
        crashes.append(f"LARP: {type(error).__name__}: {error}")
    return Tally(scenes * states_per_scene, crashes, larp_lost, truth_lost, silent, slowest)


def scene_rows(kind: str, model: Simulator, scenes: int, states_per_scene: int, seed: int) -> list[Row]:
    """Return rows of random scenes of a kind: no crash, no slow scene, no unflagged divergence."""
    tally = random_scenes(kind, model, scenes, states_per_scene, 10, seed)
    value = f"{kind}, {tally.states} states"
    crashed = f"{len(tally.crashes)} crashes" + (f", the first: {tally.crashes[0][:80]}" if tally.crashes else "")
    observation = f"{tally.silent} silent; flagged: LARP {tally.larp_lost}, MuJoCo {tally.truth_lost}"
    return [
        row("random scenes", value, "0 crashes, no scene beyond 60 s", f"{crashed}, slowest {tally.slowest:.1f} s",
            not tally.crashes and tally.slowest < 60.0),
        row("random scenes", value, "0 numbers that are not finite without saying so", observation, tally.silent == 0),
    ]  # fmt: skip
