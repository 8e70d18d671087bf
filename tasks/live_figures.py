"""Figures and plots of kicks on the page: times of plans, deadlines, costs, and misses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from mpc.loop import Execution
from tasks.run import plans_of, timing_figures
from viewer.panel import Panel


def show_figures(
    panel: Panel,
    execution: Execution,
    errors: Iterable[tuple[float, float]],
    dt: float,
    notes: Sequence[str] = (),
) -> None:
    """Show the figures of an execution so far, and of kicks before, on the panel.

    errors: miss in the ground truth and as the model expected [m], of each kick. dt: a step [s]. notes: more lines.
    """
    infos, misses = [plan.info for plan in plans_of(execution)], 100.0 * np.reshape([*errors], (-1, 2))
    lines = [*plan_lines(execution, dt), *notes, *miss_lines(misses)]
    panel.figures("\n".join(f"- {line}" for line in lines))
    costs = {name: [1e3 * info.terms[name] for info in infos] for name in infos[0].terms}
    panel.plot("Cost of the plan, in thousandths", costs, "plan")
    panel.plot("Expected error of each step [mm]", {"last plan": (1e3 * infos[-1].expected_errors).tolist()}, "step")
    if len(misses) > 1:
        panel.plot("Missed by [cm]", dict(zip(("in MuJoCo", "expected"), misses.T.tolist(), strict=True)), "kick")


def plan_lines(execution: Execution, dt: float) -> list[str]:
    """Return lines on the plans of an execution; see `show_figures`."""
    plans = plans_of(execution)
    infos, timing = [plan.info for plan in plans], timing_figures(execution, dt)
    replan_ms = 1e3 * np.array([info.seconds for info in infos][1:] or [infos[0].seconds])
    lines = [
        f"plans: first {infos[0].seconds:.2f} s; again {np.quantile(replan_ms, 0.5):.0f} ms (p50), "
        f"{np.quantile(replan_ms, 0.99):.0f} ms (p99), {timing['replans_per_second']:.0f} a second"
    ]
    lines += [f"feedback: {plan.feedback.seconds:.2f} s, once" for plan in plans if plan.feedback is not None][:1]
    lost, tried = (sum(getattr(info, name) for info in infos) for name in ("finite", "candidates"))
    lines.append(f"candidates lost: {tried - lost} of {tried}")
    if timing["lead_ms"] > 0.0:
        lines.append(f"late: {timing['deadlines_missed']} of {timing['replans']} replans")
        error = timing["prediction_error_m"]
        off = "" if math.isnan(error) else f", from a prediction that is {1e3 * error:.1f} mm off"
        lines.append(f"begun {timing['lead_ms']:.0f} ms after they are requested{off}")
    return lines


def miss_lines(misses: np.ndarray) -> list[str]:
    """Return a line on the misses (K, 2) [cm] of kicks, in the ground truth and as the model expected, if any."""
    if not len(misses):
        return []
    actual, expected = misses.mean(axis=0)
    return [f"missed by {actual:.1f} cm on average of {len(misses)}, the model said {expected:.1f}"]
