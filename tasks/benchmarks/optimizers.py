"""Comparison of optimisers, sampling, gradients and both, with the same planning time in the learned simulator."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.table import Table

from larp_model.errors import InputError
from mpc import CEM, MPPI, GaussNewton, Gradient
from tasks.benchmarks import report
from tasks.benchmarks.tradeoff import Point, measure
from tasks.command import prepare_jax, run
from tasks.kick import USUAL, Kick
from tasks.presets import Preset, Stage
from tasks.session import Session

SAMPLING, SOME = CEM(samples=64, rounds=16, elites=12, decay=1.0), CEM(samples=32, rounds=4, elites=8, decay=1.0)
FORWARD = GaussNewton(rounds=12, jacobian="forward")
# By name: optimisers of the first plan and of each replan, before they are scaled to the time.
WAYS: dict[str, tuple[Stage, Stage]] = {
    "CEM": ((SAMPLING,), (CEM(samples=32, rounds=5, elites=12, decay=1.0),)),
    "MPPI": ((MPPI(samples=64, rounds=16),), (MPPI(samples=32, rounds=5),)),
    "RMSprop on reverse gradients": ((Gradient(steps=16, elites=8),), (Gradient(steps=4, elites=8),)),
    "Gauss-Newton, differences": ((GaussNewton(rounds=12),), (GaussNewton(rounds=4),)),
    "Gauss-Newton, forward derivatives": ((FORWARD,), (GaussNewton(rounds=4, jacobian="forward"),)),
    "CEM, then Gauss-Newton, differences": ((SOME, GaussNewton(rounds=6)), (GaussNewton(rounds=4),)),
}


def compare(kick: Kick, name: str, weights: Path | None, seconds: float, targets: int, seed: int) -> report.Row:
    """Measure an optimiser, its first plan scaled to `seconds` and each replan to a fifth of them."""
    first, replan = WAYS[name]
    preset = Session(kick, "larp", weights).within(Preset(first, replan, interval=5), seconds, USUAL)
    return measure(kick, Point(preset), weights, targets, seed) | {"way": name}


def table_of(rows: list[report.Row], seconds: float) -> Table:
    """Return a table with one row per optimiser."""
    table = Table(
        "search", "error, mean +- standard error", "median", "worst", "cost of the first plan", "first plan", "replan",
        title=f"What gradients are worth, in {seconds:g} s",
    )  # fmt: skip
    for row in rows:
        table.add_row(
            f"{row['way']} ({row['point'].partition(': ')[2]})",
            f"{row['mean_truth_error_m']:.3f} +- {row['standard_error_m'] or 0.0:.3f} m",
            f"{row['median_truth_error_m']:.3f} m", f"{max(row['truth_errors_m']):.3f} m", f"{row['first_cost']:.3f}",
            f"{row['plan_seconds']:.2f} s", f"{row['replan_ms']:.0f} ms",
        )  # fmt: skip
    return table


def main(
    seconds: float = 1.0,
    targets: int = 32,
    seed: int = 7,
    json: Path = Path("runs/benchmarks/optimizers.json"),
    weights: Path | None = None,
    publish: bool = False,
) -> None:
    """Compare sampling, gradients, Gauss-Newton and both, each in the same time a plan, over the same kicks.

    Args:
        seconds: for a first plan; each replan has a fifth of them.
        targets: kicks a way; the same for all.
        seed: of targets, ball spots and planner.
        json: where the figures go.
        weights: manifest of weights that correct larp's physics; none by default.
        publish: put the table into RESULTS.md.
    """
    if targets < 1:
        raise InputError(f"targets is {targets}, but must be at least 1")
    report.ready(json, publish, weights)
    prepare_jax()
    kick = Kick.standard()
    command = f"python -m tasks.benchmarks.optimizers --seconds {seconds:g} --targets {targets} --seed {seed}"
    rows = report.collect(
        json, command, {name: partial(compare, kick, name, weights, seconds, targets, seed) for name in WAYS}
    )
    report.write_json(json, {"command": command, "hardware": report.hardware(), "rows": rows})
    table = table_of(rows, seconds)
    report.show(table)
    if publish:
        title = f"What gradients are worth: {seconds:g} s a first plan, {targets} kicks"
        report.publish("optimizers", title, command, table)


if __name__ == "__main__":
    run(main)
