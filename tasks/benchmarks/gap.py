"""Model errors on the planner's own candidates: order of their costs, and launch of the ball.

A planner seeks out the states in which its model is wrong, so that errors on random data are little evidence.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.progress import track
from rich.table import Table
from scipy.stats import spearmanr

from larp_model import evaluation
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.simulator import Simulator
from mpc import Dynamics, evaluate
from mpc.search import coloured_noise
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.kick import Kick
from tasks.models import Models, models_of
from tasks.run import plans_of
from tasks.session import Session
from tasks.targets import random_kick

# A candidate is one of the plan's elites, moved by this share of the spread of a first plan.
AROUND = 0.1
# Colours of the first, the middle and the last plan.
MARKS = ("#0072b2", "#e69f00", "#d55e00")


def candidates_of(
    session: Session, truth: Models, targets: int, candidates: int, seed: int
) -> tuple[list[dict[str, Any]], Episodes]:
    """Return model cost and ground-truth cost of candidates around each first, middle and last plan.

    Returns a row for each plan, and the ground-truth episodes of all candidates.
    """
    kick, planners = session.task, session.planners("balanced")
    spread, random = planners.first.scale, np.random.default_rng(seed)

    def costs_in(dynamics: Dynamics) -> Callable[..., tuple[jax.Array, jax.Array]]:
        @jax.jit
        def costs(state: jax.Array, controls: jax.Array, context: Any) -> tuple[jax.Array, jax.Array]:
            states = dynamics.rollout(jnp.broadcast_to(state, (len(controls), *state.shape)), controls)
            total, _ = jax.vmap(partial(evaluate, kick.terms, context=context))(states, controls)
            return total, states[:, : kick.horizon]

        return costs

    in_model, in_truth = costs_in(session.models.scene), costs_in(truth.scene)
    rows, parts = [], []
    for index in track(range(targets), description="plans", disable=not sys.stderr.isatty()):
        target, shift = random_kick(random)
        until = kick.reference.strike + 5
        plans = plans_of(session.execute(planners, target, seed + index, kick.start(shift), until))
        for replan in (plans[0], plans[len(plans) // 2], plans[-1]):
            window = kick.window(target)(replan.step)
            elites = replan.plan.elites[np.arange(candidates) % len(replan.plan.elites)]
            noise = coloured_noise(np.random.default_rng(seed + index), elites.shape, 2.0)
            perturbed = elites + AROUND * spread * noise
            controls = jnp.stack(
                [
                    planners.first.controls(replan.plan._replace(elites=knots[None]), window.reference)
                    for knots in perturbed
                ]
            )
            context = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), window.context)
            state = jnp.asarray(replan.state, jnp.float32)
            predicted, _ = in_model(state, controls, context)
            true_costs, states = in_truth(state, controls, context)
            is_finite = np.isfinite(np.asarray(true_costs)) & np.isfinite(np.asarray(predicted))
            rows.append(
                {
                    "target": target.tolist(),
                    "step": replan.step,
                    "rank_correlation": float(spearmanr(predicted[is_finite], true_costs[is_finite]).statistic),
                    "model_cost": np.asarray(predicted)[is_finite].tolist(),
                    "truth_cost": np.asarray(true_costs)[is_finite].tolist(),
                }
            )
            trajectories = np.concatenate([np.broadcast_to(state, (candidates, 1, *state.shape)), states], axis=1)[
                is_finite
            ]
            torques = np.zeros((len(trajectories), controls.shape[1], len(kick.scene.links), 3), np.float32)
            morphology = np.broadcast_to(kick.scene.morphology, (len(trajectories), *kick.scene.morphology.shape))
            parts.append(Episodes(trajectories, np.asarray(controls)[is_finite], torques, morphology))
    return rows, Episodes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Plot the cost in MuJoCo over the model's, of all candidates of first, middle and last plans."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    steps = np.array([row["step"] for row in rows])
    for which, name, colour in zip(range(3), ("first plan", "half-way", "last plan"), MARKS, strict=True):
        chosen = [row for index, row in enumerate(rows) if index % 3 == which]
        predicted = np.concatenate([row["model_cost"] for row in chosen])
        true = np.concatenate([row["truth_cost"] for row in chosen])
        axes.scatter(
            predicted, true, s=6, alpha=0.4, color=colour, label=f"{name}, step {int(np.median(steps[which::3]))}"
        )
    low, high = axes.get_xlim()[0], max(axes.get_xlim()[1], axes.get_ylim()[1])
    axes.plot([max(low, 1e-2), high], [max(low, 1e-2), high], color="0.6", lw=1)
    axes.set(xscale="log", yscale="log", xlabel="cost in the model", ylabel="cost in MuJoCo")
    axes.legend(frameon=False)
    return figure


def main(
    targets: int = 16,
    candidates: int = 64,
    seed: int = 0,
    json: Path = Path("runs/benchmarks/gap.json"),
    weights: Path | None = None,
    publish: bool = False,
) -> None:
    """Compare model and ground truth on the planner's own candidates.

    Args:
        targets: how many kicks are planned.
        candidates: of each plan.
        seed: of targets, ball spots and planner.
        json: where the figures go; the picture goes beside them.
        weights: manifest of weights that correct larp's physics; none by default.
        publish: put the table into RESULTS.md.
    """
    for name, value in (("targets", targets), ("candidates", candidates)):
        if value < 1:
            raise InputError(f"{name} is {value}, but must be at least 1")
    report.ready(json, publish, weights)
    prepare_jax()
    kick = Kick.standard()
    truth = models_of(kick.scene, "mujoco")
    rows, episodes = candidates_of(Session(kick, "larp", weights), truth, targets, candidates, seed)
    simulator = Simulator.of_physics(kick.scene) if weights is None else Simulator.load(weights, kick.scene)
    launch = evaluation.launched(simulator, episodes)
    ranks = {
        name: float(np.median([row["rank_correlation"] for row in rows[which::3]]))
        for which, name in enumerate(("first", "middle", "last"))
    }
    command = f"python -m tasks.benchmarks.gap --targets {targets} --candidates {candidates} --seed {seed}"
    content = {"command": command, "hardware": report.hardware(), "rank_correlation": ranks, "launch": launch}
    report.write_json(json, content | {"rows": rows})
    report.write_picture(json.with_suffix(".png"), picture(rows))
    table = Table("measure", "value", title="Gap on the planner's own candidates")
    for plan, rank in ranks.items():
        table.add_row(f"rank correlation of costs, {plan} plan", f"{rank:.2f}")
    for before, errors in launch.items():
        for measure, unit, scale in (("relative_error", " %", 100.0), ("angle_deg", " deg", 1.0)):
            values = ", ".join(f"{q} {scale * errors[measure][q]:.1f}{unit}" for q in ("median", "p75", "p90"))
            table.add_row(f"launch from {before} steps before contact, {measure}, {errors['count']} balls", values)
    report.show(table)
    if publish:
        report.publish("gap", f"Gap on the planner's own candidates, {targets} kicks", command, table)


if __name__ == "__main__":
    run(main)
