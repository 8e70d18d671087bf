"""Cost of a step by what a scene contains: operations, memory and time of the simulator, and MuJoCo's time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.anatomy import Detail
from larp_model.bodies import ball, chain, human, human_and_ball, kicking, kicking_links, segment_of
from larp_model.engines.mujoco import SUBSTEPS
from larp_model.errors import InputError
from larp_model.scene import Body, Pair, Scene
from larp_model.simulator import Simulator
from tasks.benchmarks import report
from tasks.benchmarks.engines import (
    GRADIENT_STEPS,
    STEPS,
    Course,
    Question,
    course,
    course_of,
    time_gradient,
    time_stepped,
    time_traced,
)
from tasks.command import prepare_jax, run
from tasks.motions.references import embedded

# Distance of neighbours that are out of each other's reach [m].
APART = 3.0
RADIUS = ball().links[0].radius
# Balls in a row; 16 with pairs of neighbours compile for more than six minutes and in 7 GB.
BALLS, MANY, TOUCHING = (1, 2, 4, 8), 16, 4
# Segments of the kicking chain.
CHAIN = ("pelvis", "torso", "thigh", "shin", "foot")
# Operations that move numbers and compute none.
MOVES = {
    *("broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "pad", "concatenate", "split"),
    *("slice", "dynamic_slice", "dynamic_update_slice", "gather", "scatter", "copy", "convert_element_type", "iota"),
    "stop_gradient",
}


@dataclass(frozen=True)
class ContentSettings:
    """Settings that figures depend on: scenes side by side, and engine steps of MuJoCo in a step."""

    batch: int
    substeps: int

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        return f"python -m tasks.benchmarks.content --batch {self.batch} --substeps {self.substeps}"


class Occupant(NamedTuple):
    """A body with its start state (L, 13), and its joint targets (T, J, 3) [rad]."""

    body: Body
    state: np.ndarray
    controls: np.ndarray


def at(body: Body, *places: tuple[float, float, float]) -> Occupant:
    """Return a body without motors at rest, its links upright at these places [m]."""
    state = np.zeros((len(places), 13))
    state[:, :3], state[:, 3] = places, 1.0
    return Occupant(body, state, np.zeros((STEPS, 0, 3)))


def balls(count: int, distance: float) -> list[Occupant]:
    """Return balls on the ground in a row, their centres so far apart [m]."""
    return [at(ball(f"ball{number}"), (distance * number, 0.0, RADIUS)) for number in range(count)]


def person(detail: Detail, name: str = "human", aside: float = 0.0) -> Occupant:
    """Return a human who moves as in the embedded kick, without ball, so far to the left [m]."""
    scene = human_and_ball(detail=detail)
    reference = embedded(scene, STEPS)
    state = reference.states[0, scene.rows("human")].copy()
    state[:, 1] += aside
    return Occupant(human(name, detail=detail), state, reference.controls[:STEPS])


class KickingChain(NamedTuple):
    """Trunk and legs of the human, whose torso has the mass of head and arms.

    links, motors: rows of the human's that it has.
    """

    body: Body
    links: list[int]
    motors: list[int]


def kicking_chain() -> KickingChain:
    """Return the kicking chain of the usual human."""
    whole = human()
    rows = [row for row, link in enumerate(whole.links) if segment_of(link.name) in CHAIN]
    links = [whole.links[row] for row in rows]
    torso = [link.name for link in links].index("torso")
    rest = sum(link.mass for link in whole.links) - sum(link.mass for link in links)
    links[torso] = replace(links[torso], mass=links[torso].mass + rest)
    joints = (whole.joints[row - 1] for row in rows[1:])
    body = Body(
        "human",
        "kicking_chain",
        tuple(links),
        tuple(replace(joint, parent=rows.index(joint.parent)) for joint in joints),
    )
    return KickingChain(body, rows, [number for number, (child, _, _) in enumerate(whole.motors) if child in rows])


def neighbours(occupants: list[Occupant]) -> tuple[Pair, ...]:
    """Return pairs of each body with the next one, of the links that kick or of all."""

    def touching(body: Body) -> tuple[str, ...]:
        return kicking_links(body) or tuple(link.name for link in body.links)

    bodies = [occupant.body for occupant in occupants]
    return tuple(
        Pair(one.name, other.name, touching(one), touching(other), one.surface) for one, other in pairwise(bodies)
    )


def courses(batch: int) -> dict[str, Callable[[], Course]]:
    """Return what scenes contain, by name, and their courses."""

    def together(occupants: list[Occupant], pairs: tuple[Pair, ...]) -> Course:
        scene = Scene(tuple(occupant.body for occupant in occupants), pairs)
        state = np.concatenate([occupant.state for occupant in occupants])
        return course_of(scene, state, np.concatenate([occupant.controls for occupant in occupants], axis=1), batch)

    def of(occupants: Callable[[], list[Occupant]], paired: bool = False) -> Callable[[], Course]:
        def build() -> Course:
            present = occupants()
            return together(present, neighbours(present) if paired else ())

        return build

    def legs_that_touch() -> Course:
        return together([person("lean")], human_and_ball(self_contact=True).within.pairs)

    def with_ball(reach: str) -> Course:
        return course(Question("larp", "human_ball", reach, 1, batch))

    def trunk_and_legs() -> list[Occupant]:
        part, whole = kicking_chain(), person("lean")
        return [Occupant(part.body, whole.state[part.links], whole.controls[:, part.motors])]

    def struck_by_chain() -> Course:
        part, whole = kicking_chain(), course(Question("larp", "human_ball", "struck", 1, 1))
        state = whole.states[0, [*part.links, -1]]
        return course_of(kicking(part.body, ball()), state, whole.controls[0][:, part.motors], batch)

    links = chain().links
    gap = links[0].length + 2.0 * links[0].radius
    hanging = [(0.0, 0.0, 1.0 + gap * number) for number in reversed(range(len(links)))]
    return {
        **{f"{count} balls, apart" if count > 1 else "ball": of(partial(balls, count, APART), True) for count in BALLS},
        f"{MANY} balls, apart, without pairs": of(partial(balls, MANY, APART)),
        f"{TOUCHING} balls, in touch": of(partial(balls, TOUCHING, 2.0 * RADIUS), True),
        "chain of 4 links": of(lambda: [at(chain(), *hanging)]),
        "trunk and legs, 8 links": of(trunk_and_legs),
        "trunk and legs and ball, struck": struck_by_chain,
        "human, 13 links": of(lambda: [person("lean")]),
        "human, 13 links, whose legs can touch": legs_that_touch,
        "human, 26 links": of(lambda: [person("full")]),
        "human and ball, far": partial(with_ball, "far"),
        "human and ball, struck": partial(with_ball, "struck"),
        "two humans": of(lambda: [person("lean"), person("lean", "other", APART)]),
        "two humans, paired, apart": of(lambda: [person("lean"), person("lean", "other", APART)], True),
    }


# Those whose gradient is measured as well.
WITH_GRADIENT = ("ball", "chain of 4 links", "human, 13 links", "human and ball, far")


def arithmetic(jaxpr: Jaxpr) -> int:
    """Return the number of floating-point operations of a program, at most.

    Loops count as often as they run, once where that is not known; of branches, the largest counts.
    """
    return sum(map(_arithmetic_of, jaxpr.eqns))


def _arithmetic_of(equation: Any) -> int:
    name, inner = equation.primitive.name, [arithmetic(jaxpr) for jaxpr in _inside(equation)]
    if name == "cond":
        return max(inner)
    if inner:
        return int(equation.params.get("length", 1)) * sum(inner)
    shape = equation.invars[0].aval.shape if equation.invars else ()
    size = sum(math.prod(variable.aval.shape) for variable in equation.outvars)
    if name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        size *= 2 * math.prod(shape[axis] for axis in contracted)
    elif name.startswith("reduce"):
        size = math.prod(shape)
    return 0 if name in MOVES else size


def _inside(equation: Any) -> Iterator[Jaxpr]:
    for value in equation.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if isinstance(part, ClosedJaxpr):
                yield part.jaxpr
            elif isinstance(part, Jaxpr):
                yield part


def content_row(name: str, build: Callable[[], Course], settings: ContentSettings) -> report.Row:
    """Return what a scene costs: a step forward, its gradient where that is measured, and MuJoCo's step."""
    workload, batch = build(), settings.batch
    simulator = Simulator.of_physics(workload.scene)
    start, control = (jnp.asarray(array, jnp.float32) for array in (workload.states, workload.controls[:, 0]))
    traced = jax.jit(simulator.step).trace(start, control)
    memory = traced.lower().compile().memory_analysis()
    question = Question("larp", name, None, 1, batch)
    timing = time_traced(question, workload)
    row = {
        "content": name,
        "links": len(workload.scene.links),
        "pairs": len(workload.scene.pairs),
        "operations": arithmetic(traced.jaxpr.jaxpr) / batch,
        "memory_kb": 1e-3 * memory.temp_size_in_bytes / batch,
        "weights_kb": 1e-3 * sum(leaf.nbytes for leaf in jax.tree.leaves(simulator.weights)),
        "compile_seconds": timing["compile_seconds"],
        "us_per_scene_step": 1e3 * timing["ms_per_step"] / batch,
        "mujoco_us_per_scene_step": 1e3
        * time_stepped(Question("mujoco", name, None, settings.substeps, batch), workload)["ms_per_step"]
        / batch,
        "gradient_us_per_scene_step": None,
    }
    if name in WITH_GRADIENT:
        short = workload._replace(controls=workload.controls[:, :GRADIENT_STEPS])
        row["gradient_us_per_scene_step"] = 1e3 * time_gradient(question, short)["ms_per_step"] / batch
    return row


def table_of(rows: list[report.Row], settings: ContentSettings) -> Table:
    """Return a table with one line for each content; all but compilation is of one scene."""
    columns = ("a scene of", "links", "pairs", "operations", "memory", "compiles in", "LARP", "gradient", "MuJoCo")
    table = Table(*columns, title=f"Cost of a step of one scene, {settings.batch} side by side")
    for row in rows:
        gradient = row["gradient_us_per_scene_step"]
        table.add_row(
            row["content"],
            str(row["links"]),
            str(row["pairs"]),
            f"{1e-3 * row['operations']:.1f} k",
            f"{row['memory_kb']:.1f} kB",
            f"{row['compile_seconds']:.0f} s",
            f"{row['us_per_scene_step']:.2f} us",
            "" if gradient is None else f"{gradient:.1f} us",
            f"{row['mujoco_us_per_scene_step']:.1f} us",
        )
    return table


def picture(rows: list[report.Row]) -> Figure:
    """Draw the time of a step by content, of both simulators."""
    figure = Figure(figsize=(9, 0.36 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))[::-1]
    for key, label, colour, offset in (
        ("us_per_scene_step", "LARP", "#d55e00", 0.18),
        ("mujoco_us_per_scene_step", "MuJoCo", "#0072b2", -0.18),
    ):
        axes.barh(places + offset, [row[key] for row in rows], 0.34, color=colour, label=label)
    axes.set_yticks(places, [row["content"] for row in rows])
    axes.set(xscale="log", xlabel="time of a step of one scene [us]", ylim=(-0.7, len(rows) - 0.3))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return figure


def main(
    batch: int = 512,
    substeps: int = SUBSTEPS,
    json: Path = Path("runs/benchmarks/content.json"),
    publish: bool = False,
) -> None:
    """Measure what a step costs by what the scene contains.

    Args:
        batch: scenes side by side.
        substeps: engine steps of MuJoCo in a step.
        json: where the figures go; the picture goes beside them.
        publish: put the table into RESULTS.md and the picture into docs/.
    """
    for name, value in (("batch", batch), ("substeps", substeps)):
        if value < 1:
            raise InputError(f"{name} is {value}, but must be at least 1")
    report.ready(json, publish)
    prepare_jax()
    jax.config.update("jax_enable_compilation_cache", False)
    settings = ContentSettings(batch, substeps)
    jobs = {name: partial(content_row, name, build, settings) for name, build in courses(batch).items()}
    rows = report.collect(json, settings.command, jobs)
    content: dict[str, Any] = {"command": settings.command, "hardware": report.hardware(), "rows": rows}
    report.write_json(json, content)
    report.write_picture(json.with_suffix(".png"), picture(rows))
    report.show(table_of(rows, settings))
    if publish:
        report.write_picture(report.PICTURES / "content.png", picture(rows))
        report.publish("content", "Content: what a step costs", settings.command, table_of(rows, settings))


if __name__ == "__main__":
    run(main)
