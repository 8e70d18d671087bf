"""Runs: the result of a task that was planned and executed, its figures, its files and its page."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth
from larp_model.files import require_writable, write_whole
from mpc.loop import Execution, PlanRecord
from tasks.gap import described, gap
from tasks.strike import strike_step
from tasks.task import Task

if TYPE_CHECKING:
    from rich.table import Table

    from viewer import LivePage, Recording

# Steps after contact up to which the miss and a fall are measured.
AFTER_CONTACT = 200
# Largest error of a step that is to be expected in usual kicks: on average 0.5 mm, at the strike, and up to 0.7 [m].
USUAL_ERROR = 1e-3
# A goal is reachable if a plan comes so near to it [m].
REACHABLE = 0.25


def plans_of(execution: Execution) -> list[PlanRecord]:
    """Return the plans of the task itself, without those of the recovery."""
    return [plan for plan in execution.plans if plan.phase == 0]


def last_plan(plans: Sequence[PlanRecord], contact: int | None) -> PlanRecord:
    """Return the last plan that began before the ball was struck in a state of this number, if it was struck.

    In a world that goes on, a plan that was requested before may begin only afterwards.
    """
    before = [plan for plan in plans if contact is None or plan.step < contact]
    return (before or plans)[-1]


def measured(contact: int | None, count: int) -> tuple[int, int]:
    """Return the range of `count` states in which the miss is measured: from first contact, if any, to 2 s after it."""
    return (0, count) if contact is None else (max(contact - 1, 0), min(contact + AFTER_CONTACT + 1, count))


def summary_of(task: Task, execution: Execution, goal: Any) -> dict[str, Any]:
    """Return the figures of an execution, entries of `summary.json`; docs/runs.md explains each."""
    states, plans = np.stack(execution.states), plans_of(execution)
    free = task.untouched(states[0], len(states) - 1)
    contact = strike_step(states, free)
    begin, end = measured(contact, len(states))
    last = last_plan(plans, contact)
    truth_error = task.missed(states[begin:end], begin, goal)
    model_error = task.missed(last.info.states, last.step + 1, goal)
    links = states[: begin + 1, task.human, packed.POSITION]
    reference = task.reference.states[: begin + 1, task.human, packed.POSITION]
    deviation = np.linalg.norm((links - links[:, :1]) - (reference - reference[:, :1]), axis=-1)
    seconds = [plan.info.seconds for plan in plans]
    replan_ms = 1e3 * np.array(seconds[1:] or seconds)
    feedbacks = [plan.feedback for plan in execution.plans if plan.feedback is not None]
    return {
        "target": jax.tree.map(lambda leaf: np.asarray(leaf, float).tolist(), goal),
        "truth_error_m": truth_error,
        "limit_error_m": truth_error if task.substeps == FINE_SUBSTEPS else replayed(task, execution, goal),
        "model_error_m": model_error,
        "metrics": task.metrics(states[begin:end], goal),
        "ball_speed_m_s": float(np.linalg.norm(states[begin:end, task.ball, packed.VELOCITY], axis=-1).max()),
        "touched": contact is not None,
        "reachable": model_error <= REACHABLE,
        "expected_errors": {
            "begin_s": last.step * task.scene.dt,
            "steps_m": [round(float(error), 7) for error in last.info.expected_errors],
        },
        "gap": gap(task.scene, states, np.concatenate([last.state[None], last.info.states]), last.step, free),
        "reference_deviation_m": float(deviation.mean()),
        "fell": bool((states[:end, 0, 2] < 0.5 * task.standing_height).any()),
        "plan_seconds": float(seconds[0]),
        "replan_ms": {"p50": float(np.quantile(replan_ms, 0.5)), "p99": float(np.quantile(replan_ms, 0.99))},
        "feedback_seconds": float(sum(feedback.seconds for feedback in feedbacks)),
        "compile_seconds": float(
            sum(plan.info.compile_seconds for plan in execution.plans)
            + sum(feedback.compile_seconds for feedback in feedbacks)
        ),
        "candidates_lost": sum(plan.info.candidates - plan.info.finite for plan in execution.plans),
        "truth_rollouts": sum(plan.info.verified for plan in plans),
    }


def timing_figures(execution: Execution, dt: float) -> dict[str, Any]:
    """Return what the replans of an execution in steps of dt [s] made of the time.

    replans: of the whole execution, and of them those missed their deadline: received after the step for which they
    were made. replans_per_second, prediction_error_m (mean) and lead_ms (mean): of the task itself, without recovery.
    """
    replans, own = execution.plans[1:], plans_of(execution)[1:]
    errors = [plan.error for plan in own if math.isfinite(plan.error)]
    return {
        "replans": len(replans),
        "deadlines_missed": sum(plan.received > plan.step for plan in replans),
        "replans_per_second": len(own) / (dt * own[-1].received) if own and own[-1].received else 0.0,
        "prediction_error_m": float(np.mean(errors)) if errors else math.nan,
        "lead_ms": float(1e3 * dt * np.mean([plan.step - plan.requested for plan in own])) if own else 0.0,
    }


def replayed(task: Task, execution: Execution, goal: Any, substeps: int = FINE_SUBSTEPS) -> float:
    """Return the miss [m] of the executed controls, replayed from the start in the ground truth.

    substeps: engine steps in a step of the replay.
    """
    start, controls = execution.states[0], np.stack(execution.controls)
    after, _ = Truth(task.scene, 1, substeps, threads=1).rollout(start[None], controls[None])
    states = np.concatenate([start[None], after[0]])
    begin, end = measured(strike_step(states, task.untouched(start, len(controls))), len(states))
    return task.missed(states[begin:end], begin, goal)


def described_errors(errors: Sequence[float] | np.ndarray, begin: float, dt: float) -> str:
    """Return the errors (T,) [m] to expect of steps of dt [s] from `begin` [s] on in a few words; empty if unknown."""
    millimetres = 1e3 * np.asarray(errors)
    if not (len(millimetres) and np.isfinite(millimetres).all()):
        return ""
    largest = int(np.argmax(millimetres))
    judgement = ": more than in usual kicks, trust the plan less" if errors[largest] > USUAL_ERROR else ""
    usual, at = np.median(millimetres), begin + (largest + 1) * dt
    return f"{usual:.2f} mm, at most {millimetres[largest]:.2f} mm at {at:.2f} s{judgement}"


def facts(task: Task, summary: dict[str, Any]) -> dict[str, str]:
    """Return a task's summary for display: labels, and values with their units."""
    lines = {
        "the model expected": f"{100 * summary['model_error_m']:.1f} cm",
        "ball speed": f"{summary['ball_speed_m_s']:.1f} m/s",
        "distance from the reference": f"{100 * summary['reference_deviation_m']:.1f} cm",
        "planned with": f"{summary['dynamics']}, {summary['preset']}",
        **{name: f"{value:.2f}" for name, value in summary["metrics"].items()},
        **described(summary["gap"]),
    }
    errors = summary["expected_errors"]
    if expectation := described_errors(errors["steps_m"], errors["begin_s"], task.scene.dt):
        lines["expected error of a step"] = expectation
    if summary["fell"]:
        lines["fell"] = "yes"
    if not summary["reachable"]:
        lines["reachable"] = "no: this plan comes nearest"
    return lines


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a task that was planned and executed in the ground truth.

    summary: the content of `summary.json`; docs/runs.md explains each entry.
    """

    task: Task
    execution: Execution
    goal: Any
    summary: dict[str, Any]

    @classmethod
    def of(cls, task: Task, execution: Execution, goal: Any, **labels: Any) -> Run:
        """Return the run of an execution for a goal; labels: further entries of the summary, such as the preset."""
        return cls(task, execution, goal, summary_of(task, execution, goal) | labels)

    @property
    def states(self) -> np.ndarray:
        """Return the executed states (T + 1, L, 13)."""
        return np.stack(self.execution.states)

    @property
    def joint_targets(self) -> np.ndarray:
        """Return the executed joint targets of the motors (T, J, 3) [rad]."""
        return np.stack(self.execution.controls)

    @property
    def plans(self) -> list[PlanRecord]:
        """Return the plans of the task itself, without those of the recovery."""
        return plans_of(self.execution)

    @property
    def last_plan(self) -> PlanRecord:
        """Return the last plan before the ball was struck, whose prediction is compared with the ground truth."""
        struck: float | None = self.summary["gap"]["contact_s"]["truth"]
        return last_plan(self.plans, None if struck is None else round(struck / self.task.scene.dt))

    @property
    def predicted(self) -> np.ndarray:
        """Return the states (T', L, 13) that the last plan predicted, from the state that it began in."""
        last = self.last_plan
        return np.concatenate([last.state[None], last.info.states])

    @property
    def truth_error_m(self) -> float:
        """Return by how much the target was missed, in the ground truth [m]."""
        return float(self.summary["truth_error_m"])

    @property
    def model_error_m(self) -> float:
        """Return by how much the last plan expected to miss the target [m]."""
        return float(self.summary["model_error_m"])

    @property
    def costs(self) -> dict[str, list[float]]:
        """Return each term's share of the cost, plan by plan."""
        return {term: [plan.info.terms[term] for plan in self.plans] for term in self.plans[-1].info.terms}

    @property
    def recording(self) -> Recording:
        """Return the recording for the viewer: ground truth, the last plan's prediction, reference."""
        from viewer import Recording

        task, states = self.task, self.states
        return Recording(
            task.scene,
            states,
            task.marker(self.goal),
            self.predicted,
            self.last_plan.step,
            task.reference.states[: len(states)],
            task.title(self.goal),
            facts(task, self.summary),
        )

    @property
    def table(self) -> Table:
        """Return the result as a table for display."""
        from rich.table import Table

        replan = self.summary["replan_ms"]["p50"]
        lines = {
            "missed by, in MuJoCo": f"{100 * self.truth_error_m:.1f} cm",
            **facts(self.task, self.summary),
            "first plan, each replan": f"{self.summary['plan_seconds']:.2f} s, {replan:.0f} ms",
        }
        table = Table("", "", title=self.task.title(self.goal), show_header=False)
        for label, value in lines.items():
            table.add_row(label, value)
        return table

    def save(self, folder: str | Path) -> Path:
        """Write `NAME.npz`, `.png`, `.html` and, last, `summary.json`, each whole or not at all; returns the folder.

        NAME is the task's; the npz holds states, joint_targets, plan_knots, plan_step and predicted_states.
        """
        from viewer import kick_picture, write_html

        folder, name, recording, last = Path(folder), self.task.name, self.recording, self.last_plan
        require_writable(folder, "folder")
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            states=recording.states.astype(np.float32),
            joint_targets=self.joint_targets.astype(np.float32),
            plan_knots=np.asarray(last.plan.knots),
            plan_step=last.step,
            predicted_states=last.info.states,
        )
        write_whole(folder / f"{name}.npz", buffer.getvalue())
        kick_picture(recording, self.costs, folder / f"{name}.png")
        write_html(recording, folder / f"{name}.html")
        write_whole(folder / "summary.json", (json.dumps(self.summary, indent=2) + "\n").encode())
        return folder

    def _repr_html_(self) -> str:
        """Return the replay as HTML, which a notebook shows for the run."""
        from viewer import framed

        return framed(self.recording)

    def show(self, host: str = "127.0.0.1", port: int = 0) -> LivePage:
        """Open a page that plays the run, at its `address`, until it is closed; port 0 takes a free one."""
        from viewer import LivePage

        page = LivePage(host, port)
        page.finish(self.recording)
        return page
