"""Cost of compiling a step of the kick and its derivatives, part by part: operations, tracing, XLA, memory and time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import Jaxpr, subjaxprs
from rich.table import Table

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.physics.ball import ball_motion
from larp_model.physics.collision import Candidates, ContactSettings, Rates
from larp_model.physics.impact import integrate
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.physics.motion import Articulation, Constants, articulated_motion
from larp_model.physics.step import SceneStep, StepInputs
from larp_model.runtime import no_garbage_collection
from larp_model.simulator import Simulator, rollout
from tasks.benchmarks import report
from tasks.command import run
from tasks.motions.references import embedded

# Runs of a compiled program, of which the median counts.
RUNS = 5
# Steps before the strike at which a rollout starts.
BEFORE = 20
COLUMNS = ("JAX", "HLO", "trace [s]", "XLA [s]", "[MB]", "run [ms]")


class Part(NamedTuple):
    """A part of a step: a function of arrays, arrays, and the directions in which it is measured."""

    function: Callable[..., Any]
    inputs: tuple[Any, ...]
    directions: tuple[str, ...] = ("forward", "gradient")


@dataclass(frozen=True)
class CompilationSettings:
    """Settings that figures depend on: scenes side by side, and steps of the rollout."""

    batch: int
    steps: int

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        return f"python -m tasks.benchmarks.compilation --batch {self.batch} --steps {self.steps}"


def parts(settings: CompilationSettings) -> dict[str, Part]:
    """Return the parts by name, in the state just before the reference's strike."""
    scene = human_and_ball()
    reference, model = embedded(scene), Simulator.of_physics(scene)
    batch, begin = settings.batch, reference.strike - BEFORE

    def copies(array: np.ndarray) -> Array:
        return jnp.broadcast_to(jnp.asarray(array, jnp.float32), (batch, *array.shape))

    states, targets = copies(reference.states[reference.strike - 1]), copies(reference.controls[reference.strike - 1])
    sizes = copies(scene.morphology)
    start = StepInputs(
        *(jnp.moveaxis(array, 0, -1) for array in (states, targets, jnp.zeros((*states.shape[:2], 3)), sizes))
    )
    one = SceneStep(scene, Constants(), ContactSettings(), lambda body, links, motion, dt: motion)
    human, ball = scene.human, scene.ball
    rows, dt = scene.rows(ball.name), 0.5 * scene.dt

    @jax.jit
    def before_contacts(start: StepInputs) -> tuple[Kinematics, Rates, dict[str, Articulation], Array]:
        return one.before_contacts(start, start.state, dt, False)[1:]

    links, rates, articulations, gaps = before_contacts(start)
    window = slice(begin, begin + settings.steps)
    controls = copies(reference.controls[window])
    trajectory = jnp.asarray(reference.states[window], jnp.float32), jnp.asarray(reference.controls[window])
    return {
        "kinematics": Part(lambda state: kinematics(scene, state, start.sizes), (start.state,)),
        "human": Part(
            lambda links, targets: articulated_motion(
                human, links, targets, start.torques[scene.rows(human.name)], scene.gravity, dt
            ),
            (links.of(scene, human.name), start.targets),
        ),
        "ball": Part(
            lambda links: ball_motion(ball, links, start.torques[rows], scene.gravity, dt),
            (links.of(scene, ball.name),),
        ),
        "gaps": Part(lambda links, rates: Candidates(scene).gaps(links, rates, dt, ContactSettings()), (links, rates)),
        "contacts": Part(
            lambda links, rates, articulations: integrate(
                scene, links, rates, articulations, gaps, dt, ContactSettings()
            ),
            (links, rates, articulations),
        ),
        "step": Part(lambda states, targets: model.step(states, targets), (states, targets)),
        f"{settings.steps} steps": Part(
            lambda states, controls: rollout(model.model, model.weights, states, controls, morphology=sizes),
            (copies(reference.states[begin]), controls),
        ),
        f"linearize {settings.steps} steps of one scene": Part(model.linearize, trajectory, ("forward",)),
    }


def gradient_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function's gradient in reverse mode, of the sum of all that it returns."""

    def gradient(*inputs: Any) -> Any:
        outputs, pull = jax.vjp(function, *inputs)
        return pull(jax.tree.map(jnp.ones_like, outputs))

    return gradient


def operations(jaxpr: Jaxpr) -> int:
    """Return the number of JAX's operations, those of loops and branches counted once."""
    return len(jaxpr.eqns) + sum(map(operations, subjaxprs(jaxpr)))


def cost(function: Callable[..., Any], inputs: tuple[Any, ...]) -> report.Row:
    """Return what a function costs to trace, to compile and to run."""
    begin = time.perf_counter()
    with no_garbage_collection():  # as the planner does
        traced = jax.jit(lambda *arguments: function(*arguments)).trace(*inputs)
        lowered = traced.lower()
    tracing = time.perf_counter() - begin
    compiled = lowered.compile()
    compiling = time.perf_counter() - begin - tracing
    jax.block_until_ready(compiled(*inputs))
    seconds = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        seconds.append(time.perf_counter() - begin)
    return {
        "operations": operations(traced.jaxpr.jaxpr),
        "hlo": compiled.as_text().count(" = "),
        "trace_s": tracing,
        "xla_s": compiling,
        "memory_mb": 1e-6 * compiled.memory_analysis().temp_size_in_bytes,
        "run_ms": 1e3 * float(np.median(seconds)),
    }


def table(rows: list[report.Row]) -> Table:
    """Return a table with one row per part, forward and gradient: operations of JAX and XLA, and the rest of a cost."""
    shown = Table("part", "", *COLUMNS, title="Cost of compiling a step of the kick")
    for row in rows:
        seconds = (f"{row[name]:.2f}" for name in ("trace_s", "xla_s"))
        figures = (str(row["operations"]), str(row["hlo"]), *seconds, f"{row['memory_mb']:.1f}", f"{row['run_ms']:.2f}")
        shown.add_row(row["part"], row["direction"], *figures)
    return shown


def main(
    batch: int = 8,
    steps: int = 40,
    json: Path = Path("runs/benchmarks/compilation.json"),
    publish: bool = False,
) -> None:
    """Compile each part of a step of the kick, its gradient, and the Jacobians of steps, without a cache.

    Args:
        batch: scenes side by side.
        steps: of the rollout.
        json: where the figures go.
        publish: put the table into RESULTS.md.
    """
    for name, value in (("batch", batch), ("steps", steps)):
        if value < 1:
            raise InputError(f"{name} is {value}, but must be at least 1")
    report.ready(json, publish)
    jax.config.update("jax_enable_compilation_cache", False)
    settings = CompilationSettings(batch, steps)

    def one(part: Part, direction: str) -> report.Row:
        function = part.function if direction == "forward" else gradient_of(part.function)
        return cost(function, part.inputs)

    jobs: dict[str, Callable[[], report.Row]] = {}
    for name, part in parts(settings).items():
        for direction in part.directions:
            labels = {"part": name, "direction": direction}
            jobs[f"{name}, {direction}"] = partial(lambda labels, *of: labels | one(*of), labels, part, direction)
    rows = report.collect(json, settings.command, jobs)
    report.write_json(json, {"command": settings.command, "hardware": report.hardware(), "rows": rows})
    report.show(table(rows))
    if publish:
        report.publish(
            "compilation", "Compilation: a step and its derivatives, part by part", settings.command, table(rows)
        )


if __name__ == "__main__":
    run(main)
