"""Stress tests of sizes, states, precision, horizons, gradients, planners and random scenes, up to failure.

Each case is a row: the quantity that is varied, its value, the promise, the observation, and whether the promise held.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.simulator import Simulator
from mpc import CEM, MPPI, CostTerm, Dynamics, GaussNewton, Gradient, Planner, Window
from mpc.loop import DivergenceError, Phase, execute
from tasks.benchmarks import gradients, kick_plans, laws, random_scenes, report, step_errors, stress, wild_states
from tasks.benchmarks.promises import Bench, refusal, row
from tasks.benchmarks.report import Row
from tasks.command import prepare_jax, run
from tasks.kick import Kick
from tasks.models import models_of
from tasks.task import check_target

COLOURS = {True: "#0072b2", False: "#d55e00"}
SMALL = CEM(samples=8, rounds=2, elites=2)


# Planners.


@dataclass(frozen=True)
class Shaky:
    """Dynamics of one link that moves by `steepness` times its target in each step.

    A candidate becomes NaN where the magnitude of a target's first number exceeds `lost` [rad].
    """

    lost: float
    steepness: float = 1.0

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        """Return the states under controls; see `mpc.Dynamics.rollout`."""
        moved = self.steepness * jnp.cumsum(controls[:, :, 0], axis=1)
        states = jnp.repeat(state[:, None], controls.shape[1], axis=1).at[..., 0, :3].add(moved)
        gone = jnp.any(jnp.abs(controls[:, :, 0, 0]) > self.lost, axis=1)
        return jnp.where(gone[:, None, None, None], jnp.nan, states)


def toy(dynamics: Any, optimizers: Any = SMALL, horizon: int = 6, knots: int = 2, spread: float = 0.1) -> Planner:
    """Return a planner that moves one link to (0.3, 0, 0) m."""
    reach = CostTerm("reach", lambda states, controls, context: states[-1, 0, :3] - jnp.array([0.3, 0.0, 0.0]))
    return Planner(dynamics, [reach], horizon, knots, 0.01, np.full((1, 3), spread), optimizers)


def planned(planner: Planner, state: Any = None, reference: Any = None) -> tuple[Any, Any]:
    """Return a first plan and its info, from the zero state and a zero reference by default."""
    state = np.zeros((1, 13)) if state is None else state
    reference = np.zeros((planner.horizon, 1, 3)) if reference is None else reference
    return planner.step(planner.init(jax.random.key(0)), state, Window(0.0, reference))


# Optimisers of the one-link planners, by name.
SEARCHES: dict[str, Any] = {
    "CEM": SMALL,
    "Gradient": Gradient(elites=2),
    "both": (SMALL, Gradient(elites=2)),
    "MPPI": MPPI(samples=8, elites=2),
    "Gauss-Newton, differences": GaussNewton(directions=6),
    "Gauss-Newton, forward": GaussNewton(directions=6, jacobian="forward"),
}
# Promises of a plan.
WARM_START = "the warm start, cost inf, 0 candidates finite"
NO_WORSE = "a finite plan that costs no more than none"

# Whether a plan and its info are as promised.
Expectation = Callable[[Any, Any], bool]


def is_warm_start(plan: Any, info: Any) -> bool:
    """Return whether no candidate was finite and the plan stayed at zero."""
    return bool(info.cost == np.inf and info.finite == 0 and not np.asarray(plan.knots).any())


def is_no_worse(plan: Any, info: Any) -> bool:
    """Return whether the plan costs no more than that of zero targets."""
    return bool(info.cost <= 0.0450001 and info.finite > 0)


def is_reference(plan: Any, info: Any) -> bool:
    """Return whether the plan is the reference itself."""
    return bool(not np.asarray(plan.knots).any() and info.finite > 0)


def plan_row(value: str, promise: str, planner: Planner, expectation: Expectation, **arguments: Any) -> Row:
    """Return the row of a first plan, which must be finite and as expected. arguments: of `planned`."""
    plan, info = planned(planner, **arguments)
    if not (np.isfinite(plan.knots).all() and np.isfinite(plan.spread).all()):
        return row("planner", value, promise, "the plan is not finite", False)
    observation = f"cost {info.cost:.3g}, {info.finite} of {info.candidates} finite"
    return row("planner", value, promise, observation, expectation(plan, info))


def small_planners() -> list[Row]:
    """Return rows of one-link planners with few candidates, lost candidates, extreme slopes or refused arguments."""
    return [*_lost_candidates(), *_fewest_candidates(), *_slopes(), *_references(), *_refused_arguments()]


def _lost_candidates() -> Iterator[Row]:
    for name, optimizers in SEARCHES.items():
        yield plan_row(f"all candidates lost, {name}", WARM_START, toy(Shaky(-1.0), optimizers), is_warm_start)
        yield plan_row(f"most candidates lost, {name}", NO_WORSE, toy(Shaky(0.05), optimizers), is_no_worse)


def _fewest_candidates() -> Iterator[Row]:
    still = Shaky(np.inf)
    for value, planner in (
        ("one candidate", toy(still, Gradient(steps=8, elites=1))),
        ("the fewest of CEM: 4", toy(still, CEM(samples=4, rounds=4, elites=2))),
        ("horizon 2, the shortest", toy(still, horizon=2)),
        ("horizon 2000", toy(still, horizon=2000)),
    ):
        yield plan_row(value, NO_WORSE, planner, is_no_worse)


def _slopes() -> Iterator[Row]:
    def is_consistent(plan: Any, info: Any) -> bool:
        return bool(np.isfinite(info.cost) == (info.finite > 0))

    forward = "Gauss-Newton, forward"
    for steepness in (1e8, 1e15, 1e25):
        for name, optimizers in (("Gradient", Gradient(steps=2, elites=1)), (forward, SEARCHES[forward])):
            planner = toy(Shaky(np.inf, steepness), optimizers)
            promise = "finite knots; cost finite, or inf and 0 finite"
            yield plan_row(f"a slope of {steepness:g} m/rad, {name}", promise, planner, is_consistent)


def _references() -> Iterator[Row]:
    still = Shaky(np.inf)
    planner, shape = toy(still), (6, 1, 3)
    yield plan_row("reference of NaN", WARM_START, planner, is_warm_start, reference=np.full(shape, np.nan))
    infinite = np.full(shape, np.inf)
    yield plan_row(
        "reference at infinity", NO_WORSE, planner, lambda plan, info: bool(info.finite > 0), reference=infinite
    )
    for name, optimizers in SEARCHES.items():
        locked = toy(still, optimizers, spread=0.0)
        yield plan_row(f"spread 0, {name}", "the reference itself", locked, is_reference)
    coarse = jnp.full(shape, 0.1234567, jnp.bfloat16)
    dtype = planner.controls(planner.init(jax.random.key(0)), coarse).dtype
    yield row("planner", "reference of bfloat16", "joint targets of 32 bits", str(dtype), dtype == jnp.float32)


def _refused_arguments() -> Iterator[Row]:
    still = Shaky(0.0)
    planner = toy(Shaky(np.inf))
    calls: tuple[tuple[str, str, Callable[[], Any]], ...] = (
        ("horizon 1", "knots", lambda: toy(still, horizon=1)),
        ("one knot", "knots", lambda: toy(still, knots=1)),
        ("one candidate of CEM", "elites", lambda: CEM(samples=1, elites=1)),
        ("no candidate of Gradient", "elites", lambda: Gradient(elites=0)),
        ("spread not finite", "spread", lambda: toy(still, spread=np.nan)),
        ("state of NaN", "state", lambda: planned(planner, state=np.full((1, 13), np.nan))),
        ("state of 1e39", "state", lambda: planned(planner, state=np.full((1, 13), 1e39))),
        ("reference of another horizon", "reference", lambda: planned(planner, reference=np.zeros((5, 1, 3)))),
        ("target at infinity", "target", lambda: check_target((np.inf, 0.0, 0.0))),
        ("target of NaN", "target", lambda: check_target((0.0, np.nan, 0.0))),
    )
    for value, words, call in calls:
        with np.errstate(over="ignore"):
            yield row("planner", value, "refused by name", *refusal(call, words))


def execution(bench: Bench) -> list[Row]:
    """Return rows of plans that are executed in a world whose states do not stay finite."""
    kick = bench.kick
    rows = []
    still = toy(Shaky(np.inf))

    class DivergingWorld:
        """World of one link whose state becomes NaN in its third step."""

        count = 0

        def reset(self, states: np.ndarray) -> None:
            """Ignore the states; see `mpc.loop.World`."""

        def step(self, control: np.ndarray) -> np.ndarray:
            """Return a zero state, or NaN in the third step; see `mpc.loop.World`."""
            self.count += 1
            return np.full((1, 1, 13), np.nan if self.count == 3 else 0.0)

    def carried_out(interval: int, reference: float) -> None:
        controls = np.full((6, 1, 3), reference)
        phase = Phase(still, still, interval, lambda step: Window(0.01 * step, controls))
        execute(DivergingWorld(), np.zeros((1, 13)), (phase,), 5, jax.random.key(0))

    for value, interval in (("lost between two plans", 10), ("lost just before a plan", 3)):
        observation, passed = refusal(partial(carried_out, interval, 0.0), "diverged in step 2", DivergenceError)
        rows.append(row("execution", value, "ends at once and names the step", observation, passed))
    truth = Truth(kick.scene, 1, threads=1)
    for name, change in (("torque of 1e9 N m", 1e9), ("torque of NaN", np.nan)):
        truth.reset(kick.start()[None])
        push = np.full((1, len(kick.scene.links), 3), change)
        states = [truth.step(bench.controls[None, 0], push) for _ in range(3)]
        lost = bool(np.isnan(states[-1]).all())
        rows.append(row("execution", name, "MuJoCo: the row is NaN from there on", "NaN" if lost else "numbers", lost))
    return rows


def caught(jobs: dict[str, Callable[[], list[Row]]]) -> dict[str, Callable[[], Row]]:
    """Wrap jobs of several rows each for `report.collect`; a job that crashes gives a row that did not hold."""

    def together(name: str, job: Callable[[], list[Row]]) -> Row:
        try:
            return {"rows": job()}
        except Exception as error:
            observation = f"{type(error).__name__}: {str(error).splitlines()[0][:120]}" if str(error) else repr(error)
            return {"rows": [row("crash", name, "ends", observation, False)]}

    return {name: partial(together, name, job) for name, job in jobs.items()}


# The report.


def jobs_of(
    bench: Bench, continued_model: Dynamics, states: int, kicks: int, seed: int
) -> dict[str, Callable[[], list[Row]]]:
    """Return the jobs of all cases but random scenes, by name.

    continued_model: the model of the scene that goes on with the ball alone. states: on which gradients are compared.
    kicks: random ones to plan, of each kind.
    """
    jobs: dict[str, Callable[[], list[Row]]] = {
        f"{body} {field}": partial(wild_states.sizes, bench, body, field)
        for body, field in (
            ("human", "length"), ("human", "radius"), ("human", "mass"), ("ball", "radius"), ("ball", "mass")
        )
    }  # fmt: skip
    return jobs | {
        "wild states": partial(wild_states.wild_states, bench),
        "far and lost": partial(wild_states.far_and_lost, bench),
        "offsets": partial(stress.offsets, bench),
        "precision": partial(stress.precision, bench),
        "batches": partial(stress.batches, bench),
        "empty batches": partial(stress.empty_batches, bench),
        "horizons": partial(stress.horizons, bench),
        "capsules": stress.geometry,
        "free bodies": partial(laws.free_bodies, bench),
        "falls": partial(laws.falls, bench),
        "bounces": laws.bounces,
        "balls with spin": laws.spinning_balls,
        "slopes of a bounce": laws.bounce_slopes,
        "planners": small_planners,
        "expected errors": partial(step_errors.expected, seed),
        "targets": partial(kick_plans.targets, bench, continued_model),
        **{
            f"random kicks: {kind}": partial(kick_plans.random_kicks, bench, continued_model, kind, kicks, seed)
            for kind in kick_plans.KINDS
        },
        "repeated plans": kick_plans.repeated_plans,
        "execution": partial(execution, bench),
        "gradients of steps": partial(gradients.of_steps, bench, states, seed),
        "slopes of a ball": partial(gradients.ball_slopes, bench),
        "gradients of kicks": partial(gradients.of_kicks, bench, continued_model, 200, seed),
    }


def scene_jobs(bench: Bench, scenes: int, seed: int) -> dict[str, Callable[[], list[Row]]]:
    """Return the jobs of random scenes by name, one of each kind; `scenes` are shared out evenly among the kinds."""

    def rows_of(kind: str) -> list[Row]:
        model = (
            bench.model if kind == "human and ball" else Simulator.of_physics(random_scenes.scene_of_kind(kind, None))
        )
        share = len(range(random_scenes.KINDS.index(kind), scenes, len(random_scenes.KINDS)))
        return random_scenes.scene_rows(kind, model, share, 20, seed)

    return {f"random scenes: {kind}": partial(rows_of, kind) for kind in random_scenes.KINDS}


def table_of(rows: list[Row], title: str) -> Table:
    """Return a table with one line per row."""
    table = Table("pushed", "to", "promised", "seen", "held", title=title)
    for case in rows:
        held = "yes" if case["held"] else "**not held**"
        table.add_row(case["axis"], case["value"], case["promise"], case["seen"], held)
    return table


def picture(rows: list[Row], title: str) -> Figure:
    """Plot each case as a square, by the quantity varied: blue where its promise held, orange where not."""
    axes_names = list(dict.fromkeys(row["axis"] for row in rows))
    half = (len(axes_names) + 1) // 2
    figure = Figure(figsize=(13, 1.4 + 0.3 * half), layout="constrained")
    figure.suptitle(title)
    most = max(sum(row["axis"] == name for row in rows) for name in axes_names)
    for axes, names in zip(figure.subplots(1, 2), (axes_names[:half], axes_names[half:]), strict=True):
        for place, name in enumerate(names):
            passed = [row["held"] for row in rows if row["axis"] == name]
            # Cases that held come first, so that their share is visible.
            passed.sort(reverse=True)
            axes.scatter(
                range(len(passed)), [place] * len(passed), c=[COLOURS[value] for value in passed], marker="s", s=26
            )
        axes.set_yticks(range(len(names)), names)
        axes.set(xlim=(-1, most), ylim=(half - 0.4, -0.6), xlabel="cases: blue held, orange not")
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(left=False)
    return figure


def main(
    scenes: int = 250,
    seed: int = 0,
    states: int = 1000,
    kicks: int = 100,
    json: Path = Path("runs/benchmarks/stability.json"),
    weights: Path | None = None,
    publish: bool = False,
) -> None:
    """Push the learned simulator, the planner and the engine until they break, and say where that is.

    Args:
        scenes: random scenes, each in 20 random states.
        seed: of scenes, states and directions.
        states: on which gradients are compared.
        kicks: random ones to plan, of each of ten kinds.
        json: where the rows go; the picture goes beside them.
        weights: manifest of weights that correct larp's physics; none by default.
        publish: put the table into RESULTS.md.
    """
    kinds = len(random_scenes.KINDS)
    if scenes < kinds:
        raise InputError(f"scenes is {scenes}, but must be at least {kinds}, one of each kind")
    if states < 32:
        raise InputError(f"states is {states}, but must be at least 32")
    if kicks < 1:
        raise InputError(f"kicks is {kicks}, but must be at least 1")
    report.ready(json, publish, weights)
    prepare_jax()
    kick = Kick.standard()
    models = models_of(kick.scene, "larp", weights)
    assert models.simulator is not None
    bench = Bench(kick, models.simulator)
    jobs = jobs_of(bench, models.scene, states, kicks, seed) | scene_jobs(bench, scenes, seed)
    command = f"python -m tasks.benchmarks.stability --scenes {scenes} --seed {seed} --states {states} --kicks {kicks}"
    rows = [row for result in report.collect(json, command, caught(jobs)) for row in result["rows"]]
    held = sum(row["held"] for row in rows)
    content = {"command": command, "hardware": report.hardware(), "cases": len(rows), "held": held, "rows": rows}
    report.write_json(json, content)
    title = f"Stability: {held} of {len(rows)} promises held"
    report.write_picture(json.with_suffix(".png"), picture(rows, title))
    table = table_of(rows, title)
    report.show(table)
    if publish:
        report.publish("stability", title, command, table)


if __name__ == "__main__":
    run(main)
