"""Interactive page of a task: its settings are planned for at once; kicks are executed and saved on request.

Planning never waits for the browser: the page draws in a thread of its own, and its settings are read before each plan.
"""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.files import arrays_of
from larp_model.scene import Scene
from mpc import Window
from mpc.loop import DivergenceError, Execution
from mpc.realtime import SimulatedLatency
from tasks.live_choices import REAL_TIME, Choices, latency_of
from tasks.live_figures import show_figures
from tasks.run import REACHABLE, Run, described_errors, facts, plans_of
from tasks.sensing import Perception, Sensing
from tasks.sensors import PERFECT, SENSORS
from tasks.session import Planners, Session
from tasks.task import Task
from viewer import (
    LivePage,
    PageClosedError,
    Push,
    Recording,
    Settings,
    kick_picture,
    page_of,
    write_film,
)

# A rehearsal ends so many steps after the reference's strike, when balance is recovered; its plans take so long [s].
REHEARSED, REHEARSED_DELAY = 30, 0.05
# Plans that the next kick's are expected to take as long as, in the median.
TIMED_PLANS = 50
# The page warns beyond this novelty, which held-out random episodes do not reach; that of usual plans is about 1. See
# `evaluation.novelty`.
NOVEL = 4.0
# Kicks whose errors are shown.
ERRORS_SHOWN = 30
FILM = (960, 540)


class PushableWorld:
    """Ground truth in which bodies can be pushed between two steps."""

    def __init__(self, scene: Scene, substeps: int) -> None:
        self._truth = Truth(scene, 1, substeps, threads=1)
        self._scene, self.pushes = scene, list[Push]()

    def reset(self, states: np.ndarray) -> None:
        """See `mpc.loop.World`."""
        self._truth.reset(states)

    def step(self, control: np.ndarray) -> np.ndarray:
        """See `mpc.loop.World`; before the step, all pushes that wait change the velocities of their bodies."""
        if self.pushes:
            states = self._truth.state()
            while self.pushes:
                push = self.pushes.pop()
                states[:, self._scene.rows(push.body), packed.VELOCITY] += push.change
            self._truth.reset(states)
        return self._truth.step(control)


class Live:
    """Server of one page until it is closed."""

    def __init__(
        self,
        page: LivePage,
        choices: Choices,
        target: np.ndarray,
        folder: Path,
        seed: int = 0,
        finished: Callable[[Run], None] = lambda run: None,
    ) -> None:
        """Begin the page with the first task, and list the kicks that are saved in the folder.

        target: (3,) [m], at first. folder: where kicks are saved. finished: called with the first run.
        """
        self.page, self.choices, self.folder, self.seed = page, choices, folder, seed
        self._finished = finished
        self._tasks: dict[str, Task] = {}
        self._sessions: dict[tuple[str, str, str], Session] = {}
        self._planners: dict[tuple[str, str, str, str, float], Planners] = {}
        self._sensing: dict[tuple[str, str], Sensing] = {}
        self._plan_seconds: dict[tuple[object, ...], deque[float]] = {}
        self.errors: deque[tuple[float, float]] = deque(maxlen=ERRORS_SHOWN)
        self.run: Run | None = None
        self.recording: Recording | None = None
        self.planned_for: Settings | None = None
        self.plans = 0
        # Of the last kick: whether it does not wait for plans, and how many steps took longer than they last.
        self._keeps_time, self._slow_steps = False, 0
        self.saved: dict[str, Path] = {}
        task = self.task(next(iter(choices.tasks)))
        page.files = self.file
        page.begin(task.scene, target, state=task.start())
        self._list_saved()

    def task(self, reference: str) -> Task:
        """Return the task near a reference, by the reference's name; it is created once."""
        if reference not in self._tasks:
            self._tasks[reference] = self.choices.tasks[reference]()
        return self._tasks[reference]

    def planners(self, settings: Settings) -> Planners:
        """Return the planners for the page's settings; they are created once."""
        key = self._planner_key(settings)
        if key not in self._planners:
            session, preset = self.session(settings), self.choices.presets[settings.preset]
            if settings.budget:
                preset = session.within(preset, settings.budget, settings.target)
            self._planners[key] = session.planners(preset)
        return self._planners[key]

    def session(self, settings: Settings) -> Session:
        """Return the session for the page's reference, dynamics and weights; it is created once."""
        key = settings.reference, settings.dynamics, settings.weights
        if key not in self._sessions:
            dynamics = next(name for name in self.choices.dynamics if name == settings.dynamics)
            weights = self.choices.weights[settings.weights]
            self._sessions[key] = Session(self.task(settings.reference), dynamics, weights)
        return self._sessions[key]

    @staticmethod
    def _planner_key(settings: Settings) -> tuple[str, str, str, str, float]:
        return settings.reference, settings.preset, settings.dynamics, settings.weights, settings.budget

    def serve(self, first: str | None = None) -> None:
        """Plan and kick on request, until the page is closed. first: a request to begin with, such as `kick`."""
        changes_planned, request = -1, first
        try:
            while True:
                if request == "kick":
                    self.carry_out()
                    changes_planned = self.page.changes  # the kick already used changes made meanwhile
                elif request in ("keep", "open", "beside", "alone"):
                    self._handle_replay(request)
                elif request == "reset" or changes_planned != self.page.changes:
                    changes_planned = self.page.changes
                    self.plan()
                request = self.page.next_request(1.0 if changes_planned == self.page.changes else 0.0)
        except (PageClosedError, KeyboardInterrupt):
            self.page.close()

    def plan(self) -> None:
        """Plan for the page's settings, and show the plan or that there is none."""
        settings = self.page.settings
        if (task := self._prepare(settings)) is None:
            return
        planner, window, state = self.planners(settings).first, self._window(task)(0), initial_state(task, settings)
        plan, info = planner.step(planner.init(jax.random.key(self.seed)), state, window)
        costs, states = planner.fan(plan, state, window)
        self.planned_for, self.plans = settings, self.plans + 1
        if not np.isfinite(info.cost):
            self.page.show_message("**No plan**: whatever was tried, the model does not know how it ends.")
            return
        fan = states[:, :, task.ball, packed.POSITION], costs
        self.page.planned(state, info.states, fan, task.reference.states[0])
        expected = task.missed(info.states, 1, task.check(settings.target))
        reach = "" if expected <= REACHABLE else " **Out of reach:** this plan comes nearest."
        expectation = f"The model expects to miss by {100.0 * expected:.1f} cm, planned in {info.seconds:.2f} s."
        controls = np.asarray(planner.controls(plan, window.reference))
        errors = described_errors(info.expected_errors, 0.0, task.scene.dt)
        lines = [
            f"**Ready.** {expectation}{reach}",
            f"Expected error of a step: {errors}." if errors else "",
            self._novelty_sentence(settings, state, info.states, controls),
        ]
        self.page.show_message("\n\n".join(line for line in lines if line))

    def carry_out(self) -> None:
        """Plan and kick in the ground truth, then play the recording; each plan uses the current target and weights."""
        settings = self.page.settings
        if (task := self._prepare(settings)) is None:
            return
        world, targets = PushableWorld(task.scene, task.substeps), [settings.target]

        def window(step: int) -> Window:
            targets.append(self.page.settings.target)
            return self._window(task)(step)

        try:
            seconds, sense = self._rehearsed(task, settings, world), self._sense(task, settings)
            planners = self.planners(settings)
            horizon = min(planners.replan.horizon, planners.recovery.horizon)
            latency = latency_of(settings.delay, task.scene.dt, seconds, self.page.speed, horizon)
            self._keeps_time = latency is not None
            execution = self.session(settings).execute(
                planners,
                settings.target,
                self.seed,
                initial_state(task, settings),
                observe=self._observer(task, settings, world, sense),
                sense=sense,
                world=world,
                window=window,
                latency=latency,
            )
            seconds.extend(plan.seconds for plan in execution.plans[1:])
            labels = {name: getattr(settings, name) for name in ("preset", "dynamics", "weights", "sensors", "delay")}
            self.run = Run.of(task, execution, task.check(targets[-1]), **labels, seed=self.seed)
            self.recording = self.run.recording
            if sense is not None:
                self.recording = replace(self.recording, estimated=states_of(sense))
        except InterruptedKickError as interruption:
            if str(interruption) == "kick":
                self.page.request("kick")
            else:
                self.plan()
            return
        except (DivergenceError, InputError) as error:
            self.page.show_message(f"**Ended:** {error}")
            return
        self.errors.append((self.run.truth_error_m, self.run.model_error_m))
        self._show_figures(execution, settings, task.scene.dt)
        self.page.finish(self.recording)
        if len(self.errors) == 1:
            self._try_to_save(self._finished, self.run)

    def _sense(self, task: Task, settings: Settings) -> Perception | None:
        """Return what the chosen sensors make of the states of a kick; None where they are perfect."""
        key = settings.reference, settings.sensors
        if key not in self._sensing:
            self._sensing[key] = Sensing(task.scene, SENSORS[settings.sensors])
        return self._sensing[key].perception(initial_state(task, settings), np.random.default_rng(self.seed))

    def _rehearsed(self, task: Task, settings: Settings, world: PushableWorld) -> deque[float]:
        """Return the times [s] that recent plans with such settings took.

        The first time, where the clock or sensors need it, these are of a kick that nobody sees: it compiles what is
        called while the clock runs.
        """
        key = (*self._planner_key(settings), settings.sensors)
        clocked = settings.delay == REAL_TIME or SENSORS[settings.sensors] != PERFECT
        if key not in self._plan_seconds and clocked:
            self.page.show_message("**Rehearsing**: what is new is compiled before the clock runs, for some seconds.")
            rehearsal = self.session(settings).execute(
                self.planners(settings),
                settings.target,
                self.seed,
                initial_state(task, settings),
                steps=task.reference.strike + REHEARSED,
                observe=lambda _: self._handle_requests(task, world),
                sense=self._sense(task, settings),
                window=self._window(task),
                latency=SimulatedLatency(task.scene.dt, REHEARSED_DELAY),
            )
            plans = rehearsal.plans[1:] or rehearsal.plans
            self._plan_seconds[key] = deque((plan.seconds for plan in plans), maxlen=TIMED_PLANS)
        return self._plan_seconds.get(key, deque())

    def _observer(
        self, task: Task, settings: Settings, world: PushableWorld, sense: Perception | None
    ) -> Callable[[Execution], None]:
        """Return a function that shows every step on the page at the page's speed.

        Estimates are known a step later than states, which are then shown a step later. It raises InterruptedKickError
        where a client requests another kick, or none.
        """
        dt, reference, due_time = task.scene.dt, task.reference.states, time.monotonic()
        step_begin, self._slow_steps = math.inf, 0

        def observe(execution: Execution) -> None:
            nonlocal due_time, step_begin
            last, estimate = plans_of(execution)[-1], None if sense is None else sense.estimates[-1].state
            is_new = last.received == len(execution.states) - 2
            step = len(execution.states) - (1 if estimate is None else 2)
            predicted = np.concatenate([last.state[None], last.info.states])[step - last.step :] if is_new else None
            self.page.update(
                execution.states[step], predicted, step * dt, reference[min(step, len(reference) - 1)], estimate
            )
            if is_new:
                self._show_figures(execution, settings, dt)
            duration = dt / self.page.speed
            self._slow_steps += time.monotonic() - step_begin > duration
            due_time = due(due_time, duration)
            self.page.hold(due_time)
            step_begin = time.monotonic()
            self._handle_requests(task, world)

        return observe

    def _handle_requests(self, task: Task, world: PushableWorld) -> None:
        """Handle what clients request while a kick runs; raise InterruptedKickError where it ends the kick."""
        while (request := self.page.next_request()) is not None:
            if request.startswith("push "):
                body = task.scene.bodies[-1 if request.endswith("ball") else 0].name
                world.pushes.append(self.page.push(body))
            elif request in ("reset", "kick"):
                raise InterruptedKickError(request)

    def file(self, kind: str, recording: Recording) -> tuple[str, bytes]:
        """Return a recording as a file: its name and content. kind: the file's extension, such as html or png."""
        name = f"{self.task(self.page.settings.reference).name}.{kind}"
        if kind == "html":
            return name, page_of(recording).encode()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            if kind == "png":
                kick_picture(recording, self.run.costs if self.run and recording is self.recording else None, path)
            else:
                write_film(recording, path, FILM, 15.0)
            return name, path.read_bytes()

    def _novelty_sentence(
        self, settings: Settings, state: np.ndarray, expected: np.ndarray, controls: np.ndarray
    ) -> str:
        """Return a sentence on the plan's novelty to the learned model; empty where nothing is learned."""
        novelty = self.session(settings).models.novelty(
            np.concatenate([state[None], expected[: len(controls)]]), controls
        )
        if novelty is None:
            return ""
        judgement = "as in its training" if novelty <= NOVEL else "**unlike its training: trust it less**"
        return f"Novelty to the model: {novelty:.1f}, {judgement}."

    def _window(self, task: Task) -> Callable[[int], Window]:
        """Return a function that gives a plan's window from the settings of the page when the plan is made."""

        def window(step: int) -> Window:
            settings = self.page.settings
            return task.window(settings.target)(step)._replace(weights=settings.terms)

        return window

    def _prepare(self, settings: Settings) -> Task | None:
        """Return the task for the settings and create its planners; if that fails, show why and return None."""
        try:
            if self._planner_key(settings) not in self._planners:
                self.page.show_message("**Setting up** what is new: the first plan compiles, for some seconds.")
            self.planners(settings)
            return self.task(settings.reference)
        except InputError as error:
            self.page.show_message(f"**Not possible:** {error}")
            return None

    def _try_to_save(self, save: Callable[[Run], object], run: Run) -> bool:
        """Write a run and return whether that worked; the page shows why not."""
        try:
            save(run)
        except (OSError, InputError) as error:
            self.page.show_message(f"**Not written:** {error}")
            return False
        return True

    def _show_figures(self, execution: Execution, settings: Settings, dt: float) -> None:
        """Show figures of a kick, and of those before, on the page."""
        notes = []
        if settings.delay == REAL_TIME:
            slow = f"slow: {self._slow_steps} of {len(execution.controls)} steps took longer than they last"
            notes.append(slow if self._keeps_time else "plans take too long for real time: the world waits")
        show_figures(self.page.panel, execution, self.errors, dt, notes)

    def _handle_replay(self, request: str) -> None:
        """Save the last kick, open a saved one, or show it beside the one being played; `alone` hides it again."""
        page = self.page
        if request == "keep" and self.run is not None:
            folder = self.folder / time.strftime("%Y-%m-%d_%H-%M-%S")
            if self._try_to_save(lambda run: run.save(folder), self.run):
                self._list_saved()
                page.show_message(f"**Kept** as {folder.name}.")
        elif request == "alone" and page.recording is not None:
            page.finish(page.recording)
        elif (name := page.panel.chosen_name(list(self.saved))) is not None and request in ("open", "beside"):
            try:
                recording = load_recording(self.task(page.settings.reference), self.saved[name])
            except InputError as error:
                page.show_message(f"**Cannot be opened:** {name}: {error}")
                return
            other = page.recording if request == "beside" else None
            page.finish(recording if other is None else other, None if other is None else recording)

    def _list_saved(self) -> None:
        """List the kicks that are saved in the run's folder, the newest first, on the page."""
        summaries = sorted(self.folder.glob("*/summary.json"), reverse=True)
        self.saved = {path.parent.name: path.parent for path in summaries}
        self.page.panel.list_saved(list(self.saved))


def initial_state(task: Task, settings: Settings) -> np.ndarray:
    """Return the state (L, 13) in which a kick begins, with the ball's place and velocity set on the page."""
    return task.start(np.array(settings.spot), np.array(settings.roll))


def states_of(sense: Perception) -> np.ndarray:
    """Return the states (T, L, 13) that were estimated."""
    return np.stack([estimate.state for estimate in sense.estimates])


def due(last: float, step: float) -> float:
    """Return when the next step is due, by `time.monotonic` [s].

    That is `step` after the last one; after a delay, at most one `step` is caught up.
    """
    return max(last + step, time.monotonic() - step)


class InterruptedKickError(Exception):
    """Request to end the running kick; the message is the request, `reset` or `kick`."""


def load_recording(task: Task, folder: Path) -> Recording:
    """Return the recording of a saved kick. Raises InputError where it is of another scene, or damaged."""
    try:
        summary = json.loads((folder / "summary.json").read_text())
        arrays = arrays_of(folder / f"{task.name}.npz")
        states, predicted, plan_step = (arrays[name] for name in ("states", "predicted_states", "plan_step"))
        target, lines = task.check(tuple(summary["target"])), facts(task, summary)
        expected = np.concatenate([states[int(plan_step)][None], predicted])
    except Exception as error:  # json, numpy and zipfile raise many kinds for a damaged file
        raise InputError(f"{folder.name} cannot be read: {type(error).__name__}: {error}") from None
    return Recording(
        task.scene,
        states,
        task.marker(target),
        expected,
        int(plan_step),
        task.reference.states[: len(states)],
        f"{task.title(target)} ({folder.name})",
        lines,
    )
