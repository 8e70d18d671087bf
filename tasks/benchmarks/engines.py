"""Time that an engine takes for a step of a scene, measured in a process of its own.

    python -m tasks.benchmarks.engines '{"engine": "mujoco", "scene": "human", ...}'

prints the result as JSON in its last line. Every engine starts from the same states, recorded in MuJoCo, under the
reference's joint targets. Each row of the batch has a small offset of its own, as a planner's candidates have.
"""

from __future__ import annotations

import json
import re
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.bodies import human_and_ball
from larp_model.engines.mujoco import SUBSTEPS, Truth, compile_model
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc.dynamics import BatchedTruth
from tasks.benchmarks import report
from tasks.benchmarks.gpu_engines import WarpTruth, networks_of_paper
from tasks.motions.references import embedded

# A row is the median of `RUNS` runs of `STEPS` steps, or of as many as fit into `SECONDS`.
STEPS, RUNS, SECONDS = 100, 5, 3.0
# Steps through which a gradient is taken.
GRADIENT_STEPS = 60
# The strike: steps that it begins before the ball moves, and steps for which a link is near the ball.
BEFORE_STRIKE, STRIKE_STEPS = 1, 3
# Distance of a ball that is out of reach [m].
AWAY = 100.0
# Spread of the offsets of joint targets [rad].
OFFSETS = 0.02
# Steps after the strike at which a ball in flight starts.
FLYING = 8
PIPELINES = ("generalized", "spring", "positional")

NAMES = {
    "larp": "LARP",
    "mujoco": "MuJoCo",
    "mjx": "MJX",
    **{f"brax {pipeline}": f"Brax {pipeline}" for pipeline in PIPELINES},
    "bullet": "Bullet",
    "mjwarp": "MuJoCo Warp",
    "networks": "the paper's networks",
    "networks bfloat16": "the paper's networks, products in bfloat16",
}
# Models that have no engine steps.
LEARNED = ("larp", "networks", "networks bfloat16")

Leaves = Any


@dataclass(frozen=True)
class Question:
    """Request for an engine's time for a step of `scene.dt`, or for a gradient through `GRADIENT_STEPS` of them.

    scene: ball, human or human_ball. reach: of the latter, "far" or "struck", else None. substeps: engine steps in a
    step; 1 for the learned simulator. seed: of the offsets of joint targets.
    """

    engine: str
    scene: str
    reach: str | None
    substeps: int
    batch: int
    gradient: bool = False
    seed: int = 0

    @property
    def coarse(self) -> bool:
        """Return whether a kick is not converged with this engine at this number of engine steps."""
        return self.engine not in LEARNED and self.substeps < SUBSTEPS

    @property
    def name(self) -> str:
        """Return a short description of engine, scene and batch."""
        suffix = " gradient" if self.gradient else ""
        return f"{titled(self.engine, self.substeps)}{suffix}, {case(self.scene, self.reach)}, batch {self.batch}"


def titled(engine: str, substeps: int) -> str:
    """Return an engine's name with its engine steps, if it has some."""
    return NAMES[engine] if engine in LEARNED else f"{NAMES[engine]} {substeps}"


def case(scene: str, reach: str | None) -> str:
    """Return a scene's name with the reach of its ball, if any."""
    return " ".join(filter(None, (scene, reach)))


class Course(NamedTuple):
    """A scene with start states (N, L, 13) and joint targets (N, T, J, 3) [rad] for T steps.

    After T steps it starts over.
    """

    scene: Scene
    states: np.ndarray
    controls: np.ndarray


def course(question: Question) -> Course:
    """Return the scene, start states and joint targets that every engine simulates.

    ball: in flight, after the reference's strike. human: the reference. human_ball far: the reference, with the ball
    100 m away. human_ball struck: the three steps around the strike, in each of which a link is near the ball, over and
    over; for a gradient, the reference from its start, which includes the strike.
    """
    full_scene = human_and_ball()
    reference = embedded(full_scene)
    begin, steps = 0, GRADIENT_STEPS if question.gradient else STEPS
    if question.reach == "struck" and not question.gradient:
        begin, steps = reference.strike - BEFORE_STRIKE, STRIKE_STEPS
    if question.scene == "ball":
        begin = reference.strike + FLYING
    bodies = question.scene.split("_")
    links = np.concatenate([np.arange(len(full_scene.links))[full_scene.rows(body)] for body in bodies])
    motors = np.concatenate([np.arange(len(full_scene.motors))[full_scene.motor_rows(body)] for body in bodies])
    state = reference.states[begin, links]
    if question.reach == "far":
        state[-1, 0] += AWAY
    targets = reference.controls[begin : begin + steps, motors.astype(int)]
    return course_of(full_scene.only(*bodies), state, targets, question.batch, question.seed)


def course_of(scene: Scene, state: np.ndarray, targets: np.ndarray, batch: int, seed: int = 0) -> Course:
    """Return the course from a state (L, 13) under joint targets (T, J, 3) [rad], with small offsets in each row."""
    offsets = OFFSETS * np.random.default_rng(seed).standard_normal((batch, 1, *targets.shape[1:]))
    return Course(scene, np.broadcast_to(state, (batch, *state.shape)), (targets + offsets).astype(np.float32))


class Traced(NamedTuple):
    """Functions of an engine that JAX compiles: initialise a batch, step it, and read its ball.

    start: states (N, L, 13) -> initial arrays. enter: these -> carry. step: carry, joint targets (N, J, 3) ->
    carry. ball: carry -> position and velocity (N, 6) [m, m/s] of the scene's last body, a ball.
    """

    start: Callable[[np.ndarray], Leaves]
    enter: Callable[[Leaves], Leaves]
    step: Callable[[Leaves, Array], Leaves]
    ball: Callable[[Leaves], Array]


def larp(scene: Scene, substeps: int) -> Traced:
    """Return LARP's simulator of physics alone."""
    return _of_states(Simulator.of_physics(scene).step)


def _of_states(step: Callable[[Array, Array], Array]) -> Traced:
    """Return the functions of a model of states (N, L, 13), by its step."""

    def ball(state: Array) -> Array:
        return jnp.concatenate([state[:, -1, packed.POSITION], state[:, -1, packed.VELOCITY]], axis=-1)

    return Traced(partial(jnp.asarray, dtype=jnp.float32), lambda start: start, step, ball)


def mjx(scene: Scene, substeps: int) -> Traced:
    """Return MJX, MuJoCo in JAX, with the same model as MuJoCo."""
    from mujoco import mjx

    compiled = compile_model(scene, substeps)
    model, blank = mjx.put_model(compiled), mjx.make_data(compiled)

    def enter(start: Leaves) -> Leaves:
        position, velocity = start
        return position, velocity, jnp.zeros_like(velocity)

    def engine_step(_: Any, carry: Leaves, control: Array) -> Leaves:
        position, velocity, acceleration = carry
        data = blank.replace(qpos=position, qvel=velocity, qacc_warmstart=acceleration, ctrl=control)
        after = mjx.step(model, data)
        return after.qpos, after.qvel, after.qacc_warmstart

    @jax.vmap
    def step(carry: Leaves, control: Array) -> Leaves:
        return jax.lax.fori_loop(0, substeps, partial(engine_step, control=control.reshape(-1)), carry)

    return Traced(partial(_coordinates, scene), enter, step, lambda carry: _last(*carry[:2]))


def brax(pipeline: str, scene: Scene, substeps: int) -> Traced:
    """Return one of Brax's pipelines, with MuJoCo's model but pyramidal friction cones and Euler integration."""
    import importlib

    import mujoco
    from brax.io import mjcf

    compiled = compile_model(scene, substeps)
    compiled.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    compiled.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    system = mjcf.load_model(compiled)
    chosen = importlib.import_module(f"brax.{pipeline}.pipeline")

    def engine_step(_: Any, carry: Leaves, control: Array) -> Leaves:
        return chosen.step(system, carry, control)

    @jax.vmap
    def step(carry: Leaves, control: Array) -> Leaves:
        return jax.lax.fori_loop(0, substeps, partial(engine_step, control=control.reshape(-1)), carry)

    enter = jax.vmap(lambda start: chosen.init(system, *start))
    return Traced(partial(_coordinates, scene), enter, step, lambda carry: _last(carry.q, carry.qd))


def _coordinates(scene: Scene, states: np.ndarray) -> tuple[Array, Array]:
    truth = Truth(scene, len(states), threads=1)
    truth.reset(states)
    position, velocity = truth.coordinates()
    return jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32)


def _last(position: Array, velocity: Array) -> Array:
    """Return position and velocity (N, 6) [m, m/s] of the last body, a free one, from MuJoCo's coordinates."""
    return jnp.concatenate([position[:, -7:-4], velocity[:, -6:-3]], axis=-1)


def bullet(scene: Scene, substeps: int, batch: int) -> BatchedTruth:
    """Return Bullet, with the same interface as the ground truth."""
    from larp_model.engines.bullet import BulletTruth

    return BulletTruth(scene, batch, substeps)


def mujoco(scene: Scene, substeps: int, batch: int) -> BatchedTruth:
    """Return the ground truth, MuJoCo, on all cores."""
    return Truth(scene, batch, substeps)


TRACED: dict[str, Callable[[Scene, int], Traced]] = {
    "larp": larp,
    "networks": lambda scene, _: _of_states(networks_of_paper(scene)),
    "networks bfloat16": lambda scene, _: _of_states(networks_of_paper(scene, "bfloat16")),
    "mjx": mjx,
    **{f"brax {pipeline}": partial(brax, pipeline) for pipeline in PIPELINES},
}
STEPPED: dict[str, Callable[[Scene, int, int], Any]] = {"mujoco": mujoco, "bullet": bullet, "mjwarp": WarpTruth}


class RefusedError(Exception):
    """Raised with the reason why an engine has no figure."""


class Compiled(NamedTuple):
    """A compiled program with the compilation time [s]."""

    run: Callable[..., Any]
    seconds: float


def compiled(program: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile a program for these arguments; raise RefusedError if it needs more memory than is free."""
    begin = time.perf_counter()
    ready = jax.jit(program).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    analysis, free = ready.memory_analysis(), available_memory()
    if analysis is not None and free is not None:
        needed = analysis.argument_size_in_bytes + analysis.output_size_in_bytes + analysis.temp_size_in_bytes
        if needed > free:
            raise RefusedError(f"needs {needed / 2**30:.1f} GiB of memory, of {free / 2**30:.1f}")
    return Compiled(ready, seconds)


def available_memory() -> int | None:
    """Return the free memory [bytes] of JAX's first device; None where it is unknown."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats["bytes_limit"] - stats["bytes_in_use"] if "bytes_limit" in stats else None
    free_kib = _proc_field(Path("/proc/meminfo"), "MemAvailable")
    return None if free_kib is None else 1024 * free_kib


def peak_memory() -> float:
    """Return the peak memory of this process [MiB].

    On Linux, child programs inherit `ru_maxrss`, so that a small child would show its parent's; `VmHWM` is read there.
    """
    peak_kib = _proc_field(Path("/proc/self/status"), "VmHWM")
    if peak_kib is not None:
        return peak_kib / 1024
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _proc_field(path: Path, field: str) -> int | None:
    """Return a field [KiB] of a table in Linux's /proc; None where there is none."""
    match = re.search(rf"^{field}:\s+(\d+)", path.read_text(), re.MULTILINE) if path.exists() else None
    return int(match.group(1)) if match else None


def timed(run: Callable[[int], float], unit: int, max_steps: int) -> report.Row:
    """Return the milliseconds per step: median and range of `RUNS` runs of `most` steps, or of fewer within `SECONDS`.

    run: number of steps, a multiple of `unit` -> seconds that they take. Its first call is not counted, unless it alone
    takes longer than `SECONDS`.
    """
    first = run(unit)
    if first > SECONDS:
        seconds, steps = [first], unit
    else:
        once = max(run(unit), 1e-9)
        steps = unit * int(np.clip(SECONDS / RUNS / once, 1, max_steps // unit))
        seconds = [run(steps) for _ in range(int(np.clip(SECONDS / (once * steps / unit), 1, RUNS)))]
    ms_per_step = 1e3 * np.array(seconds) / steps
    return {
        "ms_per_step": float(np.median(ms_per_step)),
        "ms_per_step_range": [float(ms_per_step.min()), float(ms_per_step.max())],
        "steps": steps,
        "runs": len(seconds),
    }


def time_traced(question: Question, workload: Course) -> report.Row:
    """Measure a step of an engine that JAX compiles; see `timed`."""
    traced = TRACED[question.engine](workload.scene, question.substeps)
    start, controls = traced.start(workload.states), jnp.moveaxis(jnp.asarray(workload.controls), 1, 0)
    period = len(controls)

    def program(start: Leaves, controls: Array, steps: Array) -> Leaves:
        initial = traced.enter(start)

        def body(step: Array, carry: Leaves) -> Leaves:
            if period < STEPS:
                carry = jax.tree.map(lambda new, old: jnp.where(step % period == 0, new, old), initial, carry)
            return traced.step(carry, controls[step % period])

        return jax.lax.fori_loop(0, steps, body, initial)

    ready = compiled(program, start, controls, jnp.int32(1))

    last: Leaves = None

    def run(steps: int) -> float:
        nonlocal last
        begin = time.perf_counter()
        last = jax.block_until_ready(ready.run(start, controls, jnp.int32(steps)))
        return time.perf_counter() - begin

    timing = timed(run, period if period < STEPS else 1, STEPS)
    return timing | {"compile_seconds": ready.seconds, "finite": finite(last)}


def time_gradient(question: Question, workload: Course) -> report.Row:
    """Measure `GRADIENT_STEPS` steps forward, and the same steps with the gradient by start and joint targets.

    The function that is differentiated is the sum of squares of all that the engine carries at the end.
    """
    traced = TRACED[question.engine](workload.scene, question.substeps)
    start, controls = traced.start(workload.states), jnp.moveaxis(jnp.asarray(workload.controls), 1, 0)

    def cost(start: Leaves, controls: Array) -> Array:
        last, _ = jax.lax.scan(
            lambda carry, control: (traced.step(carry, control), None), traced.enter(start), controls
        )
        return sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(last) if _differentiable(leaf)), jnp.float32(0.0))

    last: Leaves = None

    def run(steps: int) -> float:
        nonlocal last
        begin = time.perf_counter()
        last = jax.block_until_ready(ready.run(start, controls))
        return time.perf_counter() - begin

    ready = compiled(cost, start, controls)
    forward = timed(run, GRADIENT_STEPS, GRADIENT_STEPS)
    ready = compiled(jax.grad(cost, argnums=(0, 1)), start, controls)
    reverse = timed(run, GRADIENT_STEPS, GRADIENT_STEPS)
    return reverse | {
        "forward_ms": GRADIENT_STEPS * forward["ms_per_step"],
        "reverse_ms": GRADIENT_STEPS * reverse["ms_per_step"],
        "compile_seconds": ready.seconds,
        "finite": finite(last),
    }


def _differentiable(leaf: Array) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.floating))


def finite(leaves: Leaves) -> bool:
    """Return whether all numbers of all leaves are finite."""
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(leaves))


def time_stepped(question: Question, workload: Course) -> report.Row:
    """Measure a step of an engine outside JAX; resetting it to its start is not counted."""
    engine = STEPPED[question.engine](workload.scene, question.substeps, question.batch)
    period = workload.controls.shape[1]
    last = workload.states

    def run(steps: int) -> float:
        nonlocal last
        seconds = 0.0
        for begin in range(0, steps, period):
            engine.reset(workload.states)
            before = time.perf_counter()
            for step in range(min(period, steps - begin)):
                last = engine.step(workload.controls[:, step])
            seconds += time.perf_counter() - before
        return seconds

    timing = timed(run, period if period < STEPS else 1, STEPS)
    return timing | {"compile_seconds": 0.0, "finite": bool(np.isfinite(last).all())}


def answer(question: Question) -> report.Row:
    """Return the row of a question: time, compilation and memory, or in `refused` the reason why there is none."""
    idle, compiles = peak_memory(), question.engine in TRACED
    row = asdict(question) | {"device": jax.devices()[0].device_kind if compiles else "cpu", "refused": None}
    take_time = time_gradient if question.gradient else time_traced if compiles else time_stepped
    workload = course(question)
    try:
        row |= take_time(question, workload)
    except ImportError as error:
        row["refused"] = f"is not installed ({error.name or error})"
    except Exception as error:  # an engine may fail in any way: its message is the result
        row["refused"] = one_line(error)
    else:
        row["us_per_scene_step"] = 1e3 * row["ms_per_step"] / question.batch
        row |= {"peak_memory_mib": peak_memory(), "idle_memory_mib": idle}
    return row


def one_line(error: Exception) -> str:
    """Return an error's message in one line of less than 160 characters."""
    message = (str(error).strip() or type(error).__name__).splitlines()[0]
    return message if len(message) < 160 else f"{message[:157]}..."


if __name__ == "__main__":
    print(json.dumps(answer(Question(**json.loads(sys.argv[1])))))
