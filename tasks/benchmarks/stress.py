"""Stress cases of the simulator and the engine: sizes, states, precision, batches, horizons, geometry, scenes.

Cases are rows {axis, value, promise, seen: the observation, held: whether the promise was kept}; a promise is a
quantitative bound that can be violated.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import ball, capsule, chain, human, kicking_links
from larp_model.engines.mujoco import Truth
from larp_model.engines.mujoco import finite as truth_finite
from larp_model.errors import InputError
from larp_model.physics import kinematics
from larp_model.physics.collision import CapsuleShapes, closest
from larp_model.scene import Pair, Scene
from larp_model.simulator import Simulator
from mpc import CostTerm, evaluate
from tasks.benchmarks.report import Row
from tasks.kick import Kick

STEPS = 48
# Speed [m/s] that no link of a kick exceeds; MuJoCo's trajectories count as diverged beyond it.
FASTEST = 100.0
FACTORS = (0.1, 0.2, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 5.0, 10.0)
# How far the links may on average be from the engine's over 48 steps [m], and joints from being closed.
NEAR_TRUTH, CLOSED = 0.10, 0.05
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
)


class Bench(NamedTuple):
    """Subject of the stress cases: the kick's task and the learned simulator of its scene."""

    kick: Kick
    model: Simulator

    @property
    def controls(self) -> np.ndarray:
        """Return the reference's joint targets (48, J, 3) [rad]."""
        return self.kick.reference.window(0, STEPS)[1]


def row(axis: str, value: Any, promise: str, observation: str, passed: bool) -> Row:
    """Return the row of one case."""
    return {"axis": axis, "value": str(value), "promise": promise, "seen": observation, "held": bool(passed)}


def fastest(states: np.ndarray) -> float:
    """Return the greatest speed along an axis [m/s] in states (*, L, 13)."""
    return float(np.abs(np.asarray(states, float)[..., packed.VELOCITY]).max(initial=0.0))


def sound(states: np.ndarray) -> np.ndarray:
    """Return the steps of a trajectory (H, L, 13) before it is flagged as diverged by a step of NaN alone."""
    flagged = np.isnan(states).all(axis=(1, 2))
    return states[: int(flagged.argmax()) if flagged.any() else len(states)]


def bounded(axis: str, value: Any, states: np.ndarray) -> Row:
    """Check that a trajectory (H, L, 13) stays finite, with bounded speeds and unit quaternions, until flagged."""
    sound_states = np.asarray(sound(states), float)
    speed = fastest(sound_states)
    unit = float(np.abs(np.linalg.norm(sound_states[..., packed.ORIENTATION], axis=-1) - 1.0).max(initial=0.0))
    passed = bool(np.isfinite(sound_states).all() and speed <= FASTEST and unit <= 1e-3)
    promise = f"LARP: finite, quaternions of unit length, no link beyond {FASTEST:g} m/s, or flagged from there on"
    until = f", flagged after {len(sound_states)} steps" if len(sound_states) < len(states) else ""
    return row(axis, value, promise, f"fastest {speed:.3g} m/s, quaternions off by {unit:.0e}{until}", passed)


def flagged(axis: str, value: Any, states: np.ndarray, flag: bool) -> Row:
    """Check that the engine flags a trajectory (H, L, 13) that is not finite."""
    is_finite = bool(np.isfinite(states).all())
    observation = (
        "finite, not flagged" if is_finite and flag else "flagged" if not flag else "not finite and not flagged"
    )
    return row(axis, value, "MuJoCo: finite, or flagged as diverged", observation, is_finite or not flag)


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

Law = Callable[[np.ndarray, np.ndarray], tuple[str, str, bool]]


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


def offsets(bench: Bench) -> list[Row]:
    """Return rows of a kick that is shifted along the ground: predictions must shift too, within precision."""
    rows = []
    for bits, places in ((32, (10.0, 100.0, 1e3, 1e4)), (64, (1e4, 1e6))):
        with jax.enable_x64(bits == 64):
            model = in_double(bench.model) if bits == 64 else bench.model
            starts = np.tile(bench.kick.start(), (len(places) + 1, 1, 1))
            for index, place in enumerate(places):
                starts[index, :, 0] += place
            controls = np.broadcast_to(bench.controls, (len(starts), *bench.controls.shape))
            after = np.asarray(jax.jit(model.rollout)(starts, controls), float)
        for index, place in enumerate(places):
            shifted = after[index] - after[-1]
            shifted[..., 0] -= place
            moved = float(np.abs(shifted[..., packed.POSITION]).max())
            promise = f"LARP: {STEPS} steps shift with the world, within 1 cm"
            rows.append(row("offset", f"{place:g} m, float{bits}", promise, f"{100 * moved:.2g} cm", moved <= 0.01))
    truth = Truth(bench.kick.scene, 1, threads=1)
    for place in (100.0, 1e4):
        start = bench.kick.start()[None]
        start[..., 0] += place
        states, flags = truth.rollout(start, bench.controls[None])
        rows.append(flagged("offset", f"{place:g} m", states[0], bool(flags[0])))
    return rows


# Precision, batches, horizons, geometry.


def in_double(model: Simulator) -> Simulator:
    """Return the model with weights of 64 bits."""
    return replace(model, weights=jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model.weights))


def precision(bench: Bench) -> list[Row]:
    """Return rows of precision: inputs decide it, and types of too low precision are refused."""
    rows = []
    start, controls = bench.kick.start()[None], bench.controls[None]
    single = np.asarray(jax.jit(bench.model.rollout)(start, controls))
    with jax.enable_x64(True):
        model = in_double(bench.model)
        double = jax.jit(model.rollout)(start, controls)
        is_double = double.dtype == jnp.float64
        rows.append(row("precision", "float64", "LARP: 64 bits in, 64 bits out", str(double.dtype), is_double))
        mixed = bench.model.rollout(jnp.asarray(start, jnp.float32), jnp.asarray(controls[:, :2]))
        promise = "LARP: 32 bits in, 32 bits out, where JAX holds 64 too"
        rows.append(row("precision", "float32 beside float64", promise, str(mixed.dtype), mixed.dtype == jnp.float32))
        error = np.linalg.norm((np.asarray(double) - single)[..., packed.POSITION], axis=-1)[0]
    for steps, limit in ((10, 1e-3), (STEPS, 1e-2)):
        worst = float(error[:steps].max())
        promise = f"LARP: within {1e3 * limit:g} mm of float64 for {steps} steps"
        rows.append(row("precision", f"float32, {steps} steps", promise, f"{1e3 * worst:.2g} mm", worst <= limit))
    for kind in (jnp.bfloat16, jnp.float16, jnp.int32):
        for name, call in (
            ("step", partial(bench.model.step, control=jnp.asarray(controls[:, 0]))),
            ("rollout", partial(bench.model.rollout, controls=jnp.asarray(controls))),
        ):
            observation, passed = refusal(partial(call, jnp.asarray(start, kind)), "state has numbers of type")
            rows.append(row("precision", f"{kind.__name__}, {name}", "LARP: refused by name", observation, passed))
    return rows


def refusal(call: Callable[[], Any], words: str) -> tuple[str, bool]:
    """Return the message of a call that must be refused, and True if it is an InputError with these words."""
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0][:90]}", isinstance(error, InputError) and (
            words in str(error)
        )
    return "not refused", False


def batches(bench: Bench) -> list[Row]:
    """Return rows of one step of 1 to 8192 states, each row compared with the same state alone."""
    rows = []
    count = 8192
    random = np.random.default_rng(1)
    starts = np.tile(bench.kick.reference.states[0], (count, 1, 1)).astype(np.float32)
    starts[:, 0, packed.VELOCITY] += random.standard_normal((count, 3))
    controls = np.broadcast_to(bench.controls[0], (count, *bench.controls[0].shape)).astype(np.float32)
    run = jax.jit(bench.model.step)
    alone = np.concatenate([np.asarray(run(starts[i : i + 1], controls[i : i + 1])) for i in range(8)])
    for size in (1, 2, 16, 256, 2048, count):
        after = np.asarray(run(starts[:size], controls[:size]))
        compared = min(size, len(alone))
        worst = float(np.abs(after[:compared] - alone[:compared]).max())
        promise = "LARP: finite, and every row as alone within 1e-3 (m, m/s, rad/s)"
        observation = f"off by {worst:.1e}"
        rows.append(row("batch", size, promise, observation, bool(np.isfinite(after).all() and worst <= 1e-3)))
    return rows


def horizons(bench: Bench) -> list[Row]:
    """Return rows of the kick and then the reference's last targets, for up to 20 000 steps (200 s)."""
    kick, scene = bench.kick, bench.kick.scene
    length = 20_000
    controls = kick.reference.window(0, length)[1][None]
    states = np.asarray(jax.jit(bench.model.rollout)(kick.start()[None], controls))[0]
    true, _ = Truth(scene, 1, threads=1).rollout(kick.start()[None], controls)
    morphology = kinematics.morphology_of(scene)[None]
    apart = np.linalg.norm(np.asarray(kinematics.displacement(scene, jnp.asarray(states), morphology)), axis=-1)
    rows = []
    for steps in (100, 1_000, 5_000, length):
        part = sound(states[:steps])
        rows.append(bounded("horizon", f"{steps} steps", states[:steps]))
        opened = float(apart[: len(part)].max(initial=0.0))
        promise = f"LARP: joints stay closed within {100 * CLOSED:g} cm, or until flagged"
        rows.append(row("horizon", f"{steps} steps", promise, f"{100 * opened:.2g} cm", opened <= CLOSED))
        sunk = float(np.abs(part[-1, -1, 2] - scene.links[-1].radius))
        promise = "LARP: the ball lies on the ground within 1 cm at the end, or when flagged"
        if steps >= 1_000:
            rows.append(row("horizon", f"{steps} steps", promise, f"{100 * sunk:.2g} cm", sunk <= 0.01))
        rows.append(flagged("horizon", f"{steps} steps", true[0, :steps], bool(truth_finite(true[:, :steps])[0])))
    return rows


def geometry() -> list[Row]:
    """Return rows of distances of degenerate capsules, with their reverse and forward gradients."""
    x, y, zero = np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.3, 0.0]), np.zeros(3)
    pairs = {
        "centres coincide": (zero, x, zero, y, -0.15),
        "the same capsule twice": (zero, x, zero, x, -0.15),
        "parallel, side by side": (zero, x, y, x, 0.15),
        "parallel, end to end": (zero, x, 3 * x, x, 0.15),
        "antiparallel": (zero, x, y, -x, 0.15),
        "nearly parallel": (zero, x, y, x + 1e-5 * y, 0.149994),
        "both of length zero": (zero, zero, x, zero, 0.15),
        "length zero, coincident": (zero, zero, zero, zero, -0.15),
        "length zero on the axis": (zero, x, 0.5 * x, zero, -0.15),
        "crossing": (zero, x, 0.1 * x, y, -0.15),
        "1e6 m apart": (zero, x, 1e6 * y / 0.3, x, 1e6 - 0.15),
    }
    places = np.stack([np.stack(vectors) for *vectors, _ in pairs.values()])
    expected = np.array([distance for *_, distance in pairs.values()])

    def distance(numbers: jax.Array) -> jax.Array:
        one, two = (
            CapsuleShapes(
                numbers[n][None, :, None], numbers[n + 1][None, :, None], jnp.full((1, 1, 1), radius, numbers.dtype)
            )
            for n, radius in ((0, 0.1), (2, 0.05))
        )
        return closest(one, two).distance[0, 0, 0]

    rows = []
    for bits in (32, 64):
        with jax.enable_x64(bits == 64):
            numbers = jnp.asarray(places)
            value, reverse = jax.jit(jax.vmap(jax.value_and_grad(distance)))(numbers)
            forward = jax.jit(jax.vmap(jax.jacfwd(distance)))(numbers)
        off = np.abs(np.asarray(value) - expected) / np.maximum(1.0, np.abs(expected))
        apart = np.abs(np.asarray(reverse) - np.asarray(forward)).max(axis=(1, 2))
        promise = "distance right within 1e-5, gradients finite, reverse = forward within 1e-5"
        for name, wrong, differ in zip(pairs, off, apart, strict=True):
            observation = f"distance off by {wrong:.0e}, gradients by {differ:.0e}"
            rows.append(row("capsules", f"{name}, float{bits}", promise, observation, wrong <= 1e-5 and differ <= 1e-5))
    return rows


# Random scenes.


def drawn(kind: str, random: np.random.Generator | None) -> Scene:
    """Return a scene of a kind with sizes from a tenth to ten times the usual, or the usual without a generator.

    A human's height [m] is between 0.3 and 3, and so are the factors of its segments' lengths and radii.
    """

    def size(usual: float) -> float:
        return usual if random is None else float(usual * 10.0 ** random.uniform(-1.0, 1.0))

    def person(name: str) -> Any:
        if random is None:
            return human(name)
        segments = ("torso", "upper_arm", "thigh", "shin", "foot")
        lengths, radii = ({segment: float(random.uniform(0.3, 3.0)) for segment in segments} for _ in range(2))
        return human(name, float(random.uniform(0.3, 3.0)), size(70.0), lengths, radii)

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
    }
    chosen = bodies[kind]
    if len(chosen) == 1:
        return Scene(chosen)
    first, second = chosen
    first_links, second_links = (
        kicking_links(body) if body.kind == "human" else tuple(link.name for link in body.links) for body in chosen
    )
    return Scene(chosen, (Pair(first.name, second.name, first_links, second_links, ball().surface),))


def wild(scene: Scene, count: int, random: np.random.Generator) -> np.ndarray:
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
        scene = drawn(kind, random)
        state = wild(scene, states_per_scene, random)
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
