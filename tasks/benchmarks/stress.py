"""Stress cases of places, precision, batches, horizons and geometry of the simulator and the engine."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.engines.mujoco import finite as truth_finite
from larp_model.physics import kinematics
from larp_model.physics.collision import CapsuleShapes, closest
from larp_model.scene import Scene
from tasks.benchmarks.promises import CLOSED, STEPS, Bench, before_divergence, bounded, flagged, in_double, refusal, row
from tasks.benchmarks.report import Row

# Steps after which numbers of 32 bits are compared with those of 64.
LONGER = 60


def offsets(bench: Bench) -> list[Row]:
    """Return rows of a kick that is shifted along the ground: predictions must shift too, within precision."""
    rows = []
    for bits, places in ((32, (10.0, 100.0, 1e3, 1e4)), (64, (1e4, 1e6))):
        with jax.enable_x64(bits == 64):
            model = in_double(bench.model) if bits == 64 else bench.model
            far = np.tile(bench.kick.start(), (len(places), 1, 1))
            far[..., 0] += np.array(places)[:, None]
            # What is far away is rounded before it is simulated; beside it, the same near the origin.
            far = far.astype(np.float32 if bits == 32 else np.float64).astype(float)
            near = far - np.eye(packed.SIZE)[0] * np.array(places)[:, None, None]
            starts = np.concatenate([far, near])
            controls = np.broadcast_to(bench.controls, (len(starts), *bench.controls.shape))
            after = np.asarray(jax.jit(model.rollout)(starts, controls), float)
        for index, place in enumerate(places):
            shifted = after[index] - after[len(places) + index]
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


def precision(bench: Bench) -> list[Row]:
    """Return rows of precision: inputs decide it, and types of too low precision are refused."""
    rows = []
    start, controls = bench.kick.start()[None], bench.kick.reference.window(0, LONGER)[1][None]
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
    for steps, limit in ((10, 1e-3), (LONGER, 1e-3)):
        worst = float(error[:steps].max())
        promise = f"LARP: within {1e3 * limit:g} mm of float64 for {steps} steps"
        rows.append(row("precision", f"float32, {steps} steps", promise, f"{1e3 * worst:.2g} mm", worst <= limit))
    rows.append(_price_of_bfloat16(bench, start, controls, single))
    for kind in (jnp.bfloat16, jnp.float16, jnp.int32):
        for name, call in (
            ("step", partial(bench.model.step, control=jnp.asarray(controls[:, 0]))),
            ("rollout", partial(bench.model.rollout, controls=jnp.asarray(controls))),
        ):
            observation, passed = refusal(partial(call, jnp.asarray(start, kind)), "state has numbers of type")
            rows.append(row("precision", f"{kind.__name__}, {name}", "LARP: refused by name", observation, passed))
    return rows


def _price_of_bfloat16(bench: Bench, start: np.ndarray, controls: np.ndarray, single: np.ndarray) -> Row:
    """Return the row of a rollout whose states are rounded to bfloat16 after each step: why that is refused."""
    step, state, error = jax.jit(bench.model.step), jnp.asarray(start), 0.0
    for number in range(10):
        state = step(state.astype(jnp.bfloat16).astype(jnp.float32), controls[:, number])
        change = np.asarray(state)[0] - single[0, number]
        error = max(error, float(np.linalg.norm(change[:, packed.POSITION], axis=-1).max()))
    promise = "refused for its price: more than the 1 mm that float32 keeps"
    return row("precision", "bfloat16 states, 10 steps", promise, f"{1e3 * error:.2g} mm", error > 1e-3)


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
    """Return rows of 20 000 steps (200 s): of a kick, after which the human falls, and of a human who lies."""
    kick, scene, length = bench.kick, bench.kick.scene, 20_000
    kicking = kick.reference.window(0, length)[1]
    falling = np.repeat(kicking[-1:], 400, axis=0)[None]
    lying = Truth(scene, 1, threads=1).rollout(kick.start()[None], falling)[0][0, -1]
    starts = np.stack([kick.start(), lying])
    controls = np.stack([kicking, np.repeat(kicking[:1], length, axis=0)])
    states = np.asarray(jax.jit(bench.model.rollout)(starts.astype(np.float32), controls.astype(np.float32)))
    rows = []
    for name, start, control, own in zip(("a kick", "a human who lies"), starts, controls, states, strict=True):
        true, _ = Truth(scene, 1, threads=1).rollout(start[None], control[None])
        rows += _horizon_rows(scene, name, own, true[0])
    return rows


def _horizon_rows(scene: Scene, name: str, states: np.ndarray, true: np.ndarray) -> list[Row]:
    morphology = kinematics.morphology_of(scene)[None]
    apart = np.linalg.norm(np.asarray(kinematics.displacement(scene, jnp.asarray(states), morphology)), axis=-1)
    rows = []
    for steps in (100, 1_000, 5_000, len(states)):
        part, value = before_divergence(states[:steps]), f"{name}, {steps} steps"
        rows.append(bounded("horizon", value, states[:steps]))
        opened = float(apart[: len(part)].max(initial=0.0))
        promise = f"LARP: joints stay closed within {100 * CLOSED:g} cm, or until flagged"
        rows.append(row("horizon", value, promise, f"{100 * opened:.2g} cm", opened <= CLOSED))
        sunk = float(np.abs(part[-1, -1, 2] - scene.ball.links[0].radius))
        promise = "LARP: the ball lies on the ground within 1 cm at the end, or when flagged"
        if steps >= 1_000:
            rows.append(row("horizon", value, promise, f"{100 * sunk:.2g} cm", sunk <= 0.01))
        rows.append(flagged("horizon", value, true[:steps], bool(truth_finite(true[None, :steps])[0])))
    return rows


def empty_batches(bench: Bench) -> list[Row]:
    """Return rows of batches without a state: results are empty too."""
    model, scene = bench.model, bench.kick.scene
    none, controls = np.zeros((0, len(scene.links), packed.SIZE)), np.zeros((0, 4, len(scene.motors), 3))
    results = {
        "step": model.step(none, controls[:, 0]),
        "rollout": model.rollout(none, controls),
        "linearize": model.linearize(none, controls[:, 0])[0],
    }
    return [
        row("batch", f"0, {name}", "LARP: an empty result", f"shape {result.shape}", len(result) == 0)
        for name, result in results.items()
    ]


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
