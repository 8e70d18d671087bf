"""Stress cases of sizes and states: starts that do not occur in kicks, and broken ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.physics import kinematics
from larp_model.scene import Scene
from tasks.benchmarks.promises import CLOSED, STEPS, Bench, bounded, flagged, row, sound
from tasks.benchmarks.report import Row
from tasks.kick import Kick

FACTORS = (0.1, 0.2, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 5.0, 10.0)
# How far the links may on average be from the engine's over 48 steps [m].
NEAR_TRUTH = 0.10

Law = Callable[[np.ndarray, np.ndarray], tuple[str, str, bool]]


# Sizes.


def scaled(scene: Scene, name: str, field: str, factor: float) -> Scene:
    """Return the scene with one size of all links of a body times a factor; motors and surfaces stay."""

    def resized(body: Any) -> Any:
        if body.name != name:
            return body
        return replace(
            body, links=tuple(replace(link, **{field: factor * getattr(link, field)}) for link in body.links)
        )

    return replace(scene, bodies=tuple(resized(body) for body in scene.bodies))


def standing(scene: Scene, state: np.ndarray) -> np.ndarray:
    """Return a state (L, 13) with joints closed for this scene, the human's lowest link and the ball on the ground."""
    state = state.copy()
    radius = scene.links[-1].radius
    state[-1, 0] += max(radius - 0.11, 0.0)
    truth = Truth(scene, 1, threads=1)
    truth.reset(state[None])
    state = truth.state()[0]
    turned = Rotation.from_quat(state[:, packed.ORIENTATION], scalar_first=True)
    half = turned.apply([0.5 * link.length * np.asarray(link.axis) for link in scene.links])
    lowest = state[:, 2] - np.abs(half[:, 2]) - [link.radius for link in scene.links]
    state[:-1, 2] -= lowest[:-1].min()
    state[-1, 2] = radius
    return state


def sizes(bench: Bench, body: str, field: str) -> list[Row]:
    """Return rows of one size of the human or the ball, from a tenth to ten times its own."""
    scene, link_rows = bench.kick.scene, bench.kick.scene.rows(body)
    sized_scenes = [scaled(scene, body, field, factor) for factor in FACTORS]
    starts = np.stack([standing(sized, bench.kick.start()) for sized in sized_scenes])
    controls = np.broadcast_to(bench.controls, (len(FACTORS), *bench.controls.shape))
    morphology = jnp.stack([kinematics.morphology_of(sized) for sized in sized_scenes])
    states = np.asarray(jax.jit(bench.model.rollout)(starts, controls, morphology=morphology))
    apart = np.asarray(jax.jit(lambda s: kinematics.displacement(scene, s, morphology[:, None]))(jnp.asarray(states)))
    errors, rows = [], []
    for index, (factor, sized) in enumerate(zip(FACTORS, sized_scenes, strict=True)):
        true, flags = Truth(sized, 1, threads=1).rollout(starts[index][None], controls[index][None])
        distance = np.linalg.norm((states[index] - true[0])[:, link_rows, packed.POSITION], axis=-1)
        errors.append(float(distance.mean()) if flags[0] and np.isfinite(distance).all() else np.inf)
        if factor in (0.1, 0.2, 0.5, 2.0, 5.0, 10.0):
            rows.append(bounded(f"{body} {field}", f"x {factor:g}", states[index]))
            rows.append(flagged(f"{body} {field}", f"x {factor:g}", true[0], bool(flags[0])))
            if body == "human":
                opened = float(np.linalg.norm(apart[index][: len(sound(states[index]))], axis=-1).max(initial=0.0))
                promise = f"LARP: joints stay closed within {100 * CLOSED:g} cm for {STEPS} steps, or until flagged"
                observation = f"{100 * opened:.3g} cm"
                rows.append(row(f"{body} {field}", f"x {factor:g}", promise, observation, opened <= CLOSED))
    within = [error <= NEAR_TRUTH for error in errors]
    unit = FACTORS.index(1.0)
    low = unit - next((n for n, passed in enumerate(within[unit::-1]) if not passed), unit + 1) + 1
    high = unit + next((n for n, passed in enumerate(within[unit:]) if not passed), len(FACTORS) - unit) - 1
    limit = f"holds from x {FACTORS[low]:g} to x {FACTORS[high]:g}" if within[unit] else "holds nowhere"
    promise = f"LARP: links of the {body} within {100 * NEAR_TRUTH:g} cm of MuJoCo's on average over {STEPS} steps"
    for factor, error, passed in zip(FACTORS, errors, within, strict=True):
        if factor in (0.1, 0.5, 0.8, 1.25, 2.0, 10.0):
            rows.append(row(f"{body} {field}", f"x {factor:g}", promise, f"{100 * error:.3g} cm; {limit}", passed))
    return rows


# States.


class Case(NamedTuple):
    """A start (L, 13), targets (48, J, 3) [rad], a torque about y on each link [N m], and an optional law to check."""

    axis: str
    value: str
    state: np.ndarray
    controls: np.ndarray
    torque: float = 0.0
    law: Law | None = None


def keeps_energy(scene: Scene) -> Law:
    """Return the law that the last body, a ball that touches only the ground, gains no energy from its start on."""
    mass, radius = scene.links[-1].mass, scene.links[-1].radius

    def energy(states: np.ndarray) -> np.ndarray:
        moving = (states[..., -1, packed.VELOCITY] ** 2).sum(-1) + 0.4 * radius**2 * (
            states[..., -1, packed.ANGULAR_VELOCITY] ** 2
        ).sum(-1)
        return 0.5 * mass * moving + mass * scene.gravity * states[..., -1, 2]

    def law(start: np.ndarray, states: np.ndarray) -> tuple[str, str, bool]:
        gained = float((energy(states) / energy(start)).max(initial=1.0) - 1.0)
        return "LARP: the ball gains no energy, within 2 %", f"{100 * gained:+.2g} %", gained <= 0.02

    return law


def cases(kick: Kick, controls: np.ndarray) -> list[Case]:
    """Return starts that do not occur in kicks, each with the quantity that is varied."""
    scene, base = kick.scene, kick.start()
    base[-1, :2] = 3.0, 0.0
    found: list[Case] = []
    lower, upper = scene.limits
    random = np.random.default_rng(0)
    toss = random.standard_normal((len(base) - 1, 3))
    toss /= np.linalg.norm(toss, axis=-1, keepdims=True)

    def add(axis: str, value: str, change: Callable[[np.ndarray], None], **rest: Any) -> None:
        state = base.copy()
        change(state)
        found.append(Case(axis, value, state, rest.pop("targets", controls), **rest))

    def put(rows: Any, columns: Any, value: Any) -> Callable[[np.ndarray], None]:
        return lambda state: state.__setitem__((rows, columns), value)

    law, links = keeps_energy(scene), slice(0, -1)
    for speed in (5.0, 10.0, 20.0, 50.0):

        def fall(state: np.ndarray, speed: float = speed) -> None:
            state[-1, 2], state[-1, packed.VELOCITY] = 1.0, (0.3 * speed, 0.0, -speed)

        add("ball speed at the ground", f"{speed:g} m/s", fall, law=law)

        def shot(state: np.ndarray, speed: float = speed) -> None:
            place = state[kick.foot, packed.POSITION]
            state[-1, packed.POSITION] = place + np.array([0.5, 0.0, 0.05])
            state[-1, packed.VELOCITY] = -speed, 0.0, 0.0

        add("ball speed at the foot", f"{speed:g} m/s", shot)
        add("speed of every link", f"{speed:g} m/s", put(links, packed.VELOCITY, (0.6 * speed, 0.0, 0.8 * speed)))
    for angular_speed in (10.0, 50.0, 100.0, 200.0):
        add(
            "ball spin on the ground",
            f"{angular_speed:g} rad/s",
            put(-1, packed.ANGULAR_VELOCITY, (0.0, angular_speed, 0.0)),
            law=law,
        )
        add("spin of every link", f"{angular_speed:g} rad/s", put(links, packed.ANGULAR_VELOCITY, angular_speed * toss))
    nothing = lambda state: None  # noqa: E731
    for torque in (10.0, 100.0, 1e3, 1e4):
        add("torque on every link", f"{torque:g} N m", nothing, torque=torque)
    for name, bound in (("lower", lower), ("upper", upper)):
        for factor in (1.0, 2.0, 5.0):
            targets = np.broadcast_to(factor * bound, controls.shape)
            add("joint targets", f"{factor:g} x {name} limit", nothing, targets=targets)
    for angle in (np.pi, 2.0 * np.pi, 100.0):
        add("joint targets", f"{angle:.3g} rad about every axis", nothing, targets=np.full(controls.shape, angle))
    for depth in (0.01, 0.05, 0.1):
        add("ball inside the foot", f"{100 * depth:g} cm", _into_foot(kick, depth))
    add("ball inside the foot", "centres coincide", lambda s: s[-1].__setitem__(packed.POSITION, s[kick.foot, :3]))
    add("ball inside the pelvis", "centres coincide", lambda s: s[-1].__setitem__(packed.POSITION, s[0, :3]))
    for depth in (0.05, 0.11, 0.5):
        add("ball inside the ground", f"{100 * depth:g} cm", put(-1, 2, scene.links[-1].radius - depth))
    for depth in (0.05, 0.2, 1.0):
        add("human inside the ground", f"{100 * depth:g} cm", partial(_lift, -depth))
    for height in (1.0, 10.0, 100.0):
        add("human above the ground", f"{height:g} m", partial(_lift, height))
    add("all links in one place", "1 m up", put(slice(None), packed.POSITION, (0.0, 0.0, 1.0)))
    add("human on its head", "pelvis turned by pi", _upside_down)
    for scale in (-1.0, 0.5, 2.0):

        def stretch(state: np.ndarray, scale: float = scale) -> None:
            state[:, packed.ORIENTATION] *= scale

        add("length of quaternions", f"x {scale:g}", stretch)
    return found


def _into_foot(kick: Kick, depth: float) -> Callable[[np.ndarray], None]:
    reach = kick.scene.links[kick.foot].radius + kick.scene.links[-1].radius - depth
    return lambda s: s[-1].__setitem__(packed.POSITION, s[kick.foot, :3] + (0.0, -reach, 0.0))


def _lift(height: float, state: np.ndarray) -> None:
    state[:-1, 2] += height


def _upside_down(state: np.ndarray) -> None:
    turn = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    root = state[0, :3].copy()
    state[:-1, :3] = turn.apply(state[:-1, :3] - root) + root
    old = Rotation.from_quat(state[:-1, packed.ORIENTATION], scalar_first=True)
    state[:-1, packed.ORIENTATION] = (turn * old).as_quat(scalar_first=True)
    state[:-1, 2] += 0.5


def wild_states(bench: Bench) -> list[Row]:
    """Return rows of all `cases`, in LARP and in MuJoCo."""
    scene = bench.kick.scene
    all_cases = cases(bench.kick, bench.controls)
    states = np.stack([case.state for case in all_cases])
    controls = np.stack([case.controls for case in all_cases])
    torques = np.zeros((len(all_cases), STEPS, len(scene.links), 3))
    torques[:, :, :, 1] = np.array([case.torque for case in all_cases])[:, None, None]
    learned = np.asarray(jax.jit(lambda s, u, t: bench.model.rollout(s, u, torques=t))(states, controls, torques))
    true, flags = Truth(scene, len(all_cases)).rollout(states, controls, torques)
    rows = []
    for case, start, predicted, true_states, flag in zip(all_cases, states, learned, true, flags, strict=True):
        rows.append(bounded(case.axis, case.value, predicted))
        if case.law:
            rows.append(row(case.axis, case.value, *case.law(start, sound(predicted))))
        rows.append(flagged(case.axis, case.value, true_states, bool(flag)))
    return rows


def far_and_lost(bench: Bench) -> list[Row]:
    """Return rows of a very distant ball and of broken states.

    A distant ball must not affect the human, a broken state no other row of the batch.
    """
    kick, human = bench.kick, bench.kick.human
    distances = (10.0, 1e3, 1e6, 1e12, 1e20, 1e30)
    base = kick.start().astype(np.float32)
    base[-1, :2] = 3.0, 0.0
    states = np.tile(base, (len(distances) + 5, 1, 1))
    for index, distance in enumerate(distances):
        states[index, -1, 0] = distance
    lost: dict[str, tuple[Any, Any, float]] = {
        "NaN in the ball's place": (-1, 0, np.nan),
        "infinite speed of the ball": (-1, 7, np.inf),
    }
    lost |= {
        "NaN in a thigh's spin": (7, 10, np.nan),
        "quaternions of length 0": (slice(None), packed.ORIENTATION, 0.0),
    }
    for index, (rows, columns, value) in enumerate(lost.values(), start=len(distances)):
        states[index, rows, columns] = value
    controls = np.broadcast_to(bench.controls, (len(states), *bench.controls.shape))
    run = jax.jit(bench.model.rollout)
    after = np.asarray(run(states, controls))
    alone = np.asarray(run(np.tile(base, (len(states), 1, 1)), controls))
    apart = np.abs(after - alone)[..., packed.POSITION].max(axis=(1, 3))  # (N, L)
    report_rows = []
    for index, distance in enumerate(distances):
        moved, is_finite = float(apart[index][human].max()), bool(np.isfinite(after[index]).all())
        promise = f"LARP: the human within 1 mm of where it is with a ball 3 m away, {STEPS} steps; or not finite"
        observation = f"{1e3 * moved:.2g} mm" if is_finite else "not finite"
        report_rows.append(
            row("ball far away", f"{distance:g} m", promise, observation, moved <= 1e-3 or not is_finite)
        )
    beside = float(apart[-1].max())
    for index, name in enumerate(lost, start=len(distances)):
        is_finite = bool(np.isfinite(after[index]).all())
        promise = f"LARP: this row is not finite; a healthy row beside it within 1 mm of without, {STEPS} steps"
        observation = f"{'finite' if is_finite else 'not finite'}, beside it {1e3 * beside:.2g} mm"
        report_rows.append(row("state that is no state", name, promise, observation, not is_finite and beside <= 1e-3))
    return report_rows
