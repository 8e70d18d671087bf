"""Presets of a plan's optimisers and their cost, and their scaling to a time budget."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, NamedTuple

from larp_model.errors import InputError
from larp_model.names import require_known
from mpc import CEM, MPPI, Dynamics, Fallback, GaussNewton, Gradient, Optimizer

# Time of a replan, as a share of the first plan's, where a budget is given.
REPLAN_SHARE = 0.2
# Largest share of a budget that feedback may take.
FEEDBACK_SHARE = 0.5
# Candidates of the smallest round.
LEAST = 8
STEPS = GaussNewton(rounds=2, directions=24)
# A first plan that misses its target by more, in the model, has failed to converge [m]; so has a replan, which has less
# time.
FIRST_TOLERANCE, REPLAN_TOLERANCE = (("target", 0.1),), (("target", 0.05),)
REPLAN = GaussNewton(rounds=1), Fallback(REPLAN_TOLERANCE, (GaussNewton(rounds=4),))
RECOVERY = CEM(samples=64, rounds=2, elites=12, decay=1.0)

# Fields of a preset that have another name than they had.
RENAMED = {"again": "replan", "every": "interval", "enough": "tolerance", "stand": "recovery"}

Stage = tuple[Optimizer, ...]


@dataclass(frozen=True)
class Preset:
    """Trade of time for accuracy: optimisers of the first plan and of each replan, and steps between replans.

    verify: rounds of validation in the ground truth of the first plan and of each replan, at most; 0 for none. correct:
    the optimiser that searches on between two rounds. candidates: validated in a round. tolerance: a miss in the ground
    truth that ends the rounds [m]. recovery: optimisers of the plans that keep the human up after the kick. feedback:
    whether joint targets answer deviations from the plan in every step, see `mpc.feedback`; only where the model has
    derivatives.
    """

    first: Stage
    replan: Stage
    interval: int
    verify: tuple[int, int] = (0, 0)
    correct: Optimizer = STEPS
    candidates: int = 1
    tolerance: float = 0.004
    recovery: Stage = (RECOVERY,)
    feedback: bool = False

    def __post_init__(self) -> None:
        for name in ("interval", "candidates"):
            if not (_is_integer(value := getattr(self, name)) and value >= 1):
                raise InputError(f"{name} is {value!r}, but must be an integer of at least 1")
        for name in ("first", "replan", "recovery"):
            _check_stage(name, getattr(self, name))
        if not isinstance(self.feedback, bool):
            raise InputError(f"feedback is {self.feedback!r}, but must be True or False")
        pair = self.verify
        if not (isinstance(pair, tuple) and len(pair) == 2 and all(_is_integer(n) and n >= 0 for n in pair)):
            raise InputError(f"verify is {pair!r}, but must be two integers of at least 0, of first plan and replans")
        if not (isinstance(self.tolerance, int | float) and 0.0 <= self.tolerance < math.inf):
            raise InputError(f"tolerance is {self.tolerance!r}, but must be a finite number of at least 0 [m]")


def _check_stage(name: str, stage: object) -> None:
    """Raise InputError if a field of a preset is not a tuple of optimisers that can be compared."""
    if not (isinstance(stage, tuple) and stage):
        raise InputError(f"{name} is {stage!r}, but must be a tuple of at least one optimiser")
    for optimizer in stage:
        if not isinstance(optimizer, Optimizer):
            raise InputError(f"{name} holds {optimizer!r}, which is no optimiser: see mpc.Optimizer")
        if not _hashable(optimizer):
            kind = type(optimizer).__name__
            raise InputError(f"{name} holds a {kind} that cannot be hashed: make it a frozen dataclass")


def _hashable(value: object) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _first_stage(rounds: int, *searches_rounds: int) -> Stage:
    """Return the stage of a first plan: Gauss-Newton steps from the reference, then searches where they end far off.

    rounds: of the steps. searches_rounds: rounds of each search; the next search is run only where the one before did
    not converge. A search samples candidates around the reference, as many as the simulator rolls out side by side, and
    steps go on from the best of them. Its spread stays wide: convergence is left to the steps.
    """
    steps = replace(STEPS, rounds=rounds)
    searches = (CEM(32, search_rounds, 8, decay=1.0, floor=0.2) for search_rounds in searches_rounds)
    return steps, *(Fallback(FIRST_TOLERANCE, (search, steps)) for search in searches)


# Points of `tasks.benchmarks.tradeoff`. Over its 16 kicks `balanced` did better with a little sampling in its replans,
# over 64 others worse. A replan every 4th step is as often as two cores make them in a world that goes on.
PresetName = Literal["fast", "balanced", "accurate"]
PRESETS: dict[str, Preset] = {
    "fast": Preset(_first_stage(4, 8), REPLAN, interval=4, recovery=(replace(RECOVERY, rounds=1),), feedback=True),
    "balanced": Preset(_first_stage(16, 16, 64), REPLAN, interval=1, feedback=True),
    "accurate": Preset(_first_stage(16, 16, 64), REPLAN, interval=5, verify=(8, 3)),
}


def usable(dynamics: Dynamics, optimizers: Stage) -> Stage:
    """Return the optimisers that work with these dynamics: those that need gradients only where there are some."""
    return tuple(optimizer for optimizer in optimizers if dynamics.differentiable or not optimizer.differentiates)


def preset_of(name: str) -> Preset:
    """Return the preset of this name; raises InputError for an unknown one."""
    require_known("preset", name, PRESETS)
    return PRESETS[name]


def changed(preset: Preset, changes: Sequence[str]) -> Preset:
    """Return the preset with changed fields, each as NAME=VALUE: "interval=2", "replan.0.rounds=3", "verify=(4, 2)"."""
    for change in changes:
        path, _, value = change.partition("=")
        try:
            new_value = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            raise InputError(f"change is {change!r}, but must be NAME=VALUE, its value a number or (a, b)") from None
        preset = _changed(preset, path.split("."), new_value, change)
    return preset


def _changed(part: Any, path: Sequence[str], value: Any, change: str) -> Any:
    if not path:
        kinds = (int, float) if isinstance(part, float) else (type(part),)
        if type(value) not in kinds or not isinstance(part, int | float | tuple | bool):
            raise InputError(f"change is {change!r}, but what it changes is {part!r}")
        return value
    name, *rest = path
    if isinstance(part, tuple):
        require_known(f"change is {change!r}: {name}", name, map(str, range(len(part))))
        return (*part[: int(name)], _changed(part[int(name)], rest, value, change), *part[int(name) + 1 :])
    if isinstance(part, Preset) and name in RENAMED:
        raise InputError(f"change is {change!r}, but {name} is called {RENAMED[name]} now")
    names = [field.name for field in fields(part)] if is_dataclass(part) else []
    require_known(f"change is {change!r}: {name}", name, names)
    return replace(part, **{name: _changed(getattr(part, name), rest, value, change)})


class Seconds(NamedTuple):
    """Times that plans take without compilation [s]: the first one, a replan, and one that keeps the human up.

    feedback: of its computation after the first plan, 0 where the preset has none.
    """

    first: float
    replan: float
    recovery: float
    feedback: float = 0.0


def within(preset: Preset, seconds: float, measure: Callable[[Preset], Seconds]) -> Preset:
    """Return the preset with as many candidates as its first plan can evaluate in `seconds`, each replan in a fifth.

    The time of the first plan includes its feedback, which is left out where it would take more than half of it. The
    plans that keep the human up do not take longer than replans either, and optimisers that run only where a plan
    failed to converge are left out. measure: returns the times that a preset's plans take.
    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InputError(f"budget is {seconds}, but must be a finite number of seconds > 0")
    preset = replace(preset, first=_without_fallbacks(preset.first), replan=_without_fallbacks(preset.replan))
    if preset.feedback and measure(preset).feedback > FEEDBACK_SHARE * seconds:
        preset = replace(preset, feedback=False)
    fitting, factors = preset, Seconds(1.0, 1.0, 1.0)
    least = scaled(preset, Seconds(0.0, 0.0, 0.0))
    for _ in range(3):
        times = measure(fitting)
        total = times.first + times.feedback
        if fitting == least and total > seconds:
            raise InputError(f"budget is {seconds:g} s, but the least that this preset needs is {total:.2g} s")
        replan = REPLAN_SHARE * seconds
        factors = Seconds(
            factors.first * max(seconds - times.feedback, 0.0) / times.first,
            factors.replan * replan / times.replan,
            min(1.0, factors.recovery * replan / times.recovery),
        )
        fitting = scaled(preset, factors)
    return fitting


def _without_fallbacks(stage: Stage) -> Stage:
    return tuple(optimizer for optimizer in stage if not isinstance(optimizer, Fallback))


def scaled(preset: Preset, factors: Seconds) -> Preset:
    """Return the preset with `factors` times the candidates in its plans, and unchanged validation."""
    return replace(
        preset,
        first=tuple(fitted(optimizer, factors.first) for optimizer in preset.first),
        replan=tuple(fitted(optimizer, factors.replan) for optimizer in preset.replan),
        recovery=tuple(fitted(optimizer, factors.recovery) for optimizer in preset.recovery),
    )


def fitted(optimizer: Optimizer, factor: float) -> Optimizer:
    """Return the optimiser with `factor` times the candidates: by its rounds, and by a round's candidates.

    Sampling shares the factor evenly between both, `GaussNewton` has fewer directions only where no round is left to
    spare, `Gradient` scales its steps. An optimiser of any other kind stays as it is.
    """
    match optimizer:
        case CEM() | MPPI():
            total = factor * optimizer.samples * optimizer.rounds
            rounds = max(1, min(round(math.sqrt(factor) * optimizer.rounds), int(total) // LEAST))
            samples = max(LEAST, round(total / rounds))
            elites = max(2, min(optimizer.elites, samples // 4))
            return replace(optimizer, samples=samples, rounds=rounds, elites=elites)
        case GaussNewton():
            rounds = max(1, round(factor * optimizer.rounds))
            share = min(1.0, factor * optimizer.rounds)
            return replace(optimizer, rounds=rounds, directions=max(LEAST, round(share * optimizer.directions)))
        case Gradient():
            return replace(optimizer, steps=max(1, round(factor * optimizer.steps)))
    return optimizer
