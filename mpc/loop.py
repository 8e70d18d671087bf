"""The closed loop on the truth: plan, execute, shift; it records and draws nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from mpc.planner import Plan, PlanInfo, Planner


class World(Protocol):
    """What the plan is executed in, one step at a time; `larp_model.truth.mujoco.Truth` of batch 1 is one."""

    def reset(self, states: np.ndarray) -> None:
        """Put the world into states (1, L, 13)."""

    def step(self, control: np.ndarray) -> np.ndarray:
        """States (1, L, 13) after one step under joint targets (1, J, 3) [rad]."""


class Window(NamedTuple):
    """What the task wants of the next H steps: reference controls (H, J, 3) [rad] and the residuals' context."""

    controls: np.ndarray
    context: Any


class Replan(NamedTuple):
    """One planning step: when it was made, the plan and what was found."""

    step: int
    plan: Plan
    info: PlanInfo


@dataclass
class Execution:
    """What happened: states (T + 1, L, 13), joint targets (T, J, 3) [rad], and every plan on the way."""

    states: list[np.ndarray]
    controls: list[np.ndarray] = field(default_factory=list)
    replans: list[Replan] = field(default_factory=list)


def execute(
    world: World,
    state: np.ndarray,
    first: Planner,
    again: Planner,
    window: Callable[[int], Window],
    steps: int,
    every: int,
    keep_planning: Callable[[np.ndarray], bool],
    key: jax.Array,
    dt: float,
    observe: Callable[[Execution], None] = lambda execution: None,
) -> Execution:
    """Plan with `first` in `state` (L, 13), execute, and replan with `again` every `every` steps from the true state.

    Planning ends for good when `keep_planning(state)` is false; the last plan is then carried out, and after its end
    the task's reference. Both planners share horizon, knots and elites. `observe` is called after every step.
    """
    world.reset(state[None])
    execution = Execution([np.asarray(state)])
    plan, planned_at, planning = first.init(key), 0, True
    targets = np.zeros(0)
    for step in range(steps):
        current = execution.states[-1]
        planning = planning and keep_planning(current)
        if planning and step % every == 0:
            wanted = window(step)
            planner = again if step else first
            plan, info = planner.step(plan, current, wanted.controls, wanted.context, now=step * dt)
            targets, planned_at = np.asarray(planner.controls(plan, wanted.controls)), step
            execution.replans.append(Replan(step, plan, info))
        ahead = step - planned_at
        control = targets[ahead] if ahead < len(targets) else window(step).controls[0]
        execution.controls.append(control)
        execution.states.append(world.step(control[None])[0])
        observe(execution)
    return execution
