"""Stress cases of sizes and states: starts that do not occur in kicks, and broken ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.physics import kinematics
from larp_model.scene import Body, Scene
from tasks.benchmarks.promises import CLOSED, STEPS, Bench, before_divergence, bounded, flagged, row
from tasks.benchmarks.report import Row
from tasks.kick import Kick

FACTORS = (0.1, 0.2, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 5.0, 10.0)
# How far the links may on average be from the engine's over 48 steps [m].
NEAR_TRUTH = 0.10

Law = Callable[[np.ndarray, np.ndarray], tuple[str, str, bool]]


# Sizes.


def scaled(scene: Scene, name: str, field: str, factor: float) -> Scene:
    """Return the scene with one size of all links of a body times a factor, and motors in proportion."""
    column = ("length", "radius", "mass").index(field)

    def resized(body: Body) -> Body:
        sizes = body.sizes
        sizes[:, column] *= factor
        return body.sized(sizes) if body.name == name else body

    return replace(scene, bodies=tuple(resized(body) for body in scene.bodies))


def standing(scene: Scene, state: np.ndarray) -> np.ndarray:
    """Return a state (L, 13) with joints closed for this scene, the human's lowest link and the ball on the ground.

    The ball lies ahead of all that it would otherwise be inside of.
    """
    truth = Truth(scene, 1, threads=1)
    truth.reset(state[None])
    state = truth.state()[0]
    turned = Rotation.from_quat(state[:, packed.ORIENTATION], scalar_first=True)
    half = np.abs(turned.apply([0.5 * link.length * np.asarray(link.axis) for link in scene.links]))
    extent = half + np.array([link.radius for link in scene.links])[:, None]
    radius = scene.ball.links[0].radius
    state[:-1, 2] -= (state[:-1, 2] - extent[:-1, 2]).min()
    state[-1, 0] = max(state[-1, 0], (state[:-1, 0] + extent[:-1, 0]).max() + radius)
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
                opened = float(
                    np.linalg.norm(apart[index][: len(before_divergence(states[index]))], axis=-1).max(initial=0.0)
                )
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


class StressCase(NamedTuple):
    """A start (L, 13), targets (48, J, 3) [rad], a torque about y on each link [N m], and an optional law to check."""

    axis: str
    value: str
    state: np.ndarray
    controls: np.ndarray
    torque: float = 0.0
    law: Law | None = None


def keeps_energy(scene: Scene) -> Law:
    """Return the law that the last body, a ball that touches only the ground, gains no energy from its start on."""
    mass, radius = scene.ball.links[0].mass, scene.ball.links[0].radius

    def energy(states: np.ndarray) -> np.ndarray:
        moving = (states[..., -1, packed.VELOCITY] ** 2).sum(-1) + 0.4 * radius**2 * (
            states[..., -1, packed.ANGULAR_VELOCITY] ** 2
        ).sum(-1)
        total: np.ndarray = 0.5 * mass * moving + mass * scene.gravity * states[..., -1, 2]
        return total

    def law(start: np.ndarray, states: np.ndarray) -> tuple[str, str, bool]:
        gained = float((energy(states) / energy(start)).max(initial=1.0) - 1.0)
        return "LARP: the ball gains no energy, within 2 %", f"{100 * gained:+.2g} %", gained <= 0.02

    return law


Change = Callable[[np.ndarray], None]


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a kick, (L, 13), with joint targets (48, J, 3) [rad], from which cases differ by one change."""

    kick: Kick
    state: np.ndarray
    controls: np.ndarray

    def case(
        self,
        axis: str,
        value: str,
        change: Change = lambda state: None,
        targets: np.ndarray | None = None,
        torque: float = 0.0,
        law: Law | None = None,
    ) -> StressCase:
        """Return the case of this start after a change in place, by default none; see `StressCase`."""
        state = self.state.copy()
        change(state)
        return StressCase(axis, value, state, self.controls if targets is None else targets, torque, law)


def cases(kick: Kick, controls: np.ndarray) -> list[StressCase]:
    """Return starts that do not occur in kicks, each with the quantity that is varied."""
    state = kick.start()
    state[-1, :2] = 3.0, 0.0
    start = Start(kick, state, controls)
    parts = (_speeds, _angular_speeds, _torques, _joint_targets, _overlaps, _heights, _wrong_states)
    return [case for part in parts for case in part(start)]


def _put(rows: Any, columns: Any, value: Any) -> Change:
    return lambda state: state.__setitem__((rows, columns), value)


def _speeds(start: Start) -> Iterator[StressCase]:
    law = keeps_energy(start.kick.scene)
    for speed in (5.0, 10.0, 20.0, 50.0):
        value, slanting = f"{speed:g} m/s", (0.6 * speed, 0.0, 0.8 * speed)
        yield start.case("ball speed at the ground", value, partial(_fall, speed), law=law)
        yield start.case("ball speed at the foot", value, partial(_shoot_at, start.kick.foot, speed))
        yield start.case("speed of every link", value, _put(slice(0, -1), packed.VELOCITY, slanting))


def _fall(speed: float, state: np.ndarray) -> None:
    state[-1, 2], state[-1, packed.VELOCITY] = 1.0, (0.3 * speed, 0.0, -speed)


def _shoot_at(foot: int, speed: float, state: np.ndarray) -> None:
    state[-1, packed.POSITION] = state[foot, packed.POSITION] + np.array([0.5, 0.0, 0.05])
    state[-1, packed.VELOCITY] = -speed, 0.0, 0.0


def _angular_speeds(start: Start) -> Iterator[StressCase]:
    law = keeps_energy(start.kick.scene)
    axes = np.random.default_rng(0).standard_normal((len(start.state) - 1, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    for speed in (10.0, 50.0, 100.0, 200.0):
        value = f"{speed:g} rad/s"
        rolling = _put(-1, packed.ANGULAR_VELOCITY, (0.0, speed, 0.0))
        yield start.case("ball spin on the ground", value, rolling, law=law)
        yield start.case("spin of every link", value, _put(slice(0, -1), packed.ANGULAR_VELOCITY, speed * axes))


def _torques(start: Start) -> Iterator[StressCase]:
    for torque in (10.0, 100.0, 1e3, 1e4):
        yield start.case("torque on every link", f"{torque:g} N m", torque=torque)


def _joint_targets(start: Start) -> Iterator[StressCase]:
    shape = start.controls.shape
    for name, bound in zip(("lower", "upper"), start.kick.scene.limits, strict=True):
        for factor in (1.0, 2.0, 5.0):
            targets = np.broadcast_to(factor * bound, shape)
            yield start.case("joint targets", f"{factor:g} x {name} limit", targets=targets)
    for angle in (np.pi, 2.0 * np.pi, 100.0):
        yield start.case("joint targets", f"{angle:.3g} rad about every axis", targets=np.full(shape, angle))


def _overlaps(start: Start) -> Iterator[StressCase]:
    kick, foot = start.kick, start.kick.foot
    for depth in (0.01, 0.05, 0.1):
        yield start.case("ball inside the foot", f"{100 * depth:g} cm", _into_foot(kick, depth))
    for name, link in (("foot", foot), ("pelvis", 0)):
        yield start.case(f"ball inside the {name}", "centres coincide", partial(_ball_to, link))
    for depth in (0.05, 0.11, 0.5):
        lowered = _put(-1, 2, kick.scene.ball.links[0].radius - depth)
        yield start.case("ball inside the ground", f"{100 * depth:g} cm", lowered)
    for depth in (0.05, 0.2, 1.0):
        yield start.case("human inside the ground", f"{100 * depth:g} cm", partial(_lift, -depth))


def _into_foot(kick: Kick, depth: float) -> Change:
    reach = kick.scene.links[kick.foot].radius + kick.scene.ball.links[0].radius - depth
    return lambda state: state[-1].__setitem__(packed.POSITION, state[kick.foot, :3] + (0.0, -reach, 0.0))


def _ball_to(link: int, state: np.ndarray) -> None:
    state[-1, packed.POSITION] = state[link, packed.POSITION]


def _heights(start: Start) -> Iterator[StressCase]:
    for height in (1.0, 10.0, 100.0):
        yield start.case("human above the ground", f"{height:g} m", partial(_lift, height))


def _lift(height: float, state: np.ndarray) -> None:
    state[:-1, 2] += height


def _wrong_states(start: Start) -> Iterator[StressCase]:
    yield start.case("all links in one place", "1 m up", _put(slice(None), packed.POSITION, (0.0, 0.0, 1.0)))
    yield start.case("human on its head", "pelvis turned by pi", _upside_down)
    for scale in (-1.0, 0.5, 2.0):
        yield start.case("length of quaternions", f"x {scale:g}", partial(_stretch, scale))


def _stretch(scale: float, state: np.ndarray) -> None:
    state[:, packed.ORIENTATION] *= scale


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
            rows.append(row(case.axis, case.value, *case.law(start, before_divergence(predicted))))
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
