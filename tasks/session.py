"""Sessions: the models and planners of a task, and the execution of its plans in MuJoCo or another world."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from larp_model.engines.mujoco import SUBSTEPS, Truth
from mpc import Dynamics, Optimizer, Plan, PlanInfo, Planner, Verified, Window
from mpc.dynamics import linearizable
from mpc.loop import Execution, Latency, Phase, Sense, World, execute
from tasks.models import NO_WEIGHTS, DynamicsName, models_of
from tasks.presets import PRESETS, Preset, PresetName, Seconds, preset_of, usable, within
from tasks.run import AFTER_CONTACT, Run
from tasks.standing import Standing
from tasks.task import Task

# Steps for which a plan is executed further once the task is done: for as long as the ball may be pushed.
HOLD_STEPS = 6
# Steps between the plans of recovery, until so many after the strike, and from then on.
RECOVERY_INTERVAL, RECOVERY, STANDING_INTERVAL = 4, 70, 12


class Planners(NamedTuple):
    """Planners of the first plan, of later ones, every `interval` steps, and of the recovery of balance afterwards.

    feedback: whether joint targets answer deviations from the plan, see `mpc.feedback`.
    """

    first: Planner
    replan: Planner
    interval: int
    recovery: Planner
    feedback: bool = False


class Session:
    """Models of a task's scene, and planners that share compiled programs.

    Runs with a preset that was used before compile nothing again. A session can be copied and pickled; copies compile
    their own programs.
    """

    def __init__(
        self,
        task: Task,
        dynamics: DynamicsName | Dynamics = "larp",
        weights: str | Path | None = None,
        substeps: int = SUBSTEPS,
    ) -> None:
        """Set up the models of a task.

        dynamics: the planner's model, by name or your own of the whole scene; recovery is then planned with ours.
        weights: manifest of the model's weights; none by default. substeps: engine steps in a step of MuJoCo as the
        model.
        """
        self.task = task
        manifest = None if weights is None else Path(weights)
        if isinstance(dynamics, str):
            self.dynamics, self.models = str(dynamics), models_of(task.scene, dynamics, manifest, substeps)
        else:
            self.dynamics = type(dynamics).__name__
            self.models = models_of(task.scene, "larp", manifest)._replace(
                scene=dynamics, simulator=None, weights=NO_WEIGHTS
            )
        self._planners: dict[Preset, Planners] = {}

    @cached_property
    def _standing(self) -> Standing:
        return Standing(self.task.scene, self.task.reference)

    @cached_property
    def _planner(self) -> Planner:
        return self.task.planner(self.models.scene, PRESETS["fast"].first)

    @cached_property
    def _recovery(self) -> Planner:
        return self._standing.planner(self.models.human, PRESETS["fast"].recovery)

    def planners(self, preset: PresetName | Preset = "balanced") -> Planners:
        """Return a preset's planners, made once.

        Where MuJoCo is the model, plans are not validated in the ground truth.
        """
        preset = preset_of(preset) if isinstance(preset, str) else preset
        if preset not in self._planners:
            stages: list[tuple[Optimizer, ...]] = [preset.first, preset.replan]
            if any(preset.verify) and not self.models.exact:
                rows = max(2, preset.candidates)  # the warm start is validated beside the first proposal
                truth = models_of(self.task.scene, "mujoco", substeps=self.task.substeps, rows=rows).scene
                tolerance = (("target", preset.tolerance),)
                for stage, rounds in enumerate(preset.verify):
                    if rounds:
                        verified = Verified(truth, preset.correct, rounds, preset.candidates, tolerance)
                        stages[stage] = (*stages[stage], verified)
            first, replan = (self._planner.using(usable(self.models.scene, stage)) for stage in stages)
            recovery = self._recovery.using(usable(self.models.human, preset.recovery))
            self._planners[preset] = Planners(
                first, replan, preset.interval, recovery, preset.feedback and linearizable(self.models.scene)
            )
        return self._planners[preset]

    def within(self, preset: Preset, budget: float, goal: Any) -> Preset:
        """Return the preset scaled to a budget of a plan [s]; see `presets.within`. goal: any typical one."""
        return within(preset, budget, partial(self.seconds, goal))

    def seconds(self, goal: Any, preset: Preset) -> Seconds:
        """Return the times that the preset's plans take for a goal, with full horizons."""
        planners, window = self.planners(preset), self.task.window(goal)(0)
        start, results = self.task.start(), list[tuple[Plan, PlanInfo]]()
        for planner, ahead, links in (
            (planners.first, window, slice(None)),
            (planners.replan, window, slice(None)),
            (planners.recovery, self._standing.window(0), self.task.human),
        ):
            plans = [planner.step(planner.init(jax.random.key(0)), start[links], ahead) for _ in range(2)]
            results.append(min(plans, key=lambda result: result[1].seconds))
        times = Seconds(*(info.seconds for _, info in results))
        if not planners.feedback:
            return times
        plan, info = results[0]
        timed = (planners.first.feedback(plan, info, start, window)[1].seconds for _ in range(2))
        return times._replace(feedback=min(timed))

    def execute(
        self,
        planners: Planners,
        goal: Any,
        seed: int,
        state: ArrayLike | None = None,
        steps: int | None = None,
        observe: Callable[[Execution], None] = lambda execution: None,
        sense: Sense | None = None,
        recovers: bool = True,
        world: World | None = None,
        window: Callable[[int], Window] | None = None,
        latency: Latency | None = None,
    ) -> Execution:
        """Plan and execute in the ground truth, from a state (the task's start by default), for `steps`.

        steps: by default until 20 + `AFTER_CONTACT` steps after the reference's strike. recovers: whether plans go on
        after the task is done, to keep the human up. world: to execute in instead. window: gives the planner's window
        from a step on, if its goal is not always the same. latency: of plans, see `mpc.realtime`; none by default.
        """
        task, strike = self.task, self.task.reference.strike
        state = task.start() if state is None else task.check_state(state)
        steps = strike + 20 + AFTER_CONTACT if steps is None else steps
        free = task.untouched(state, steps)
        first, replan, interval, recovery, feedback = planners

        def is_done(step: int, state: np.ndarray) -> bool:
            return task.is_done(step, state, free[step])

        phases = [Phase(first, replan, interval, window or task.window(goal), is_done, HOLD_STEPS, feedback=feedback)]
        if recovers:
            ahead, end = self._standing.window, strike + RECOVERY
            phases += [
                Phase(recovery, recovery, RECOVERY_INTERVAL, ahead, lambda step, _: step >= end, links=task.human),
                Phase(recovery, recovery, STANDING_INTERVAL, ahead, links=task.human),
            ]
        world = world or Truth(task.scene, 1, task.substeps, threads=1)
        return execute(world, state, phases, steps, jax.random.key(seed), observe, sense, latency=latency)

    def run(
        self,
        goal: Any,
        preset: PresetName | Preset = "balanced",
        seed: int = 0,
        state: ArrayLike | None = None,
        observe: Callable[[Execution], None] = lambda execution: None,
        world: World | None = None,
        sense: Sense | None = None,
        latency: Latency | None = None,
    ) -> Run:
        """Plan for a goal and execute in MuJoCo, or in a world of your own.

        goal: of a kick, the target (3,) [m]. preset: its name, or one of your own. seed: of the planner's random
        numbers. state: (L, 13) to begin in; see `Task.start`. observe: called after every step. sense: what the
        planner gets to see, see `tasks.sensing`; the state by default. latency: of plans, while the world goes on, see
        `mpc.realtime`; by default the world waits for them.
        """
        goal = self.task.check(goal)
        planners = self.planners(preset)
        execution = self.execute(
            planners, goal, seed, state, observe=observe, sense=sense, world=world, latency=latency
        )
        name = preset if isinstance(preset, str) else type(preset).__name__
        weights = self.models.weights
        return Run.of(self.task, execution, goal, preset=name, dynamics=self.dynamics, weights=weights, seed=seed)
