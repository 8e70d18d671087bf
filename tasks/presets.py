"""What a plan may cost: presets, and presets that fit into a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from mpc import CEM, Gradient

# Time of a replan, as a share of the first plan's, where a budget is given.
AGAIN = 0.2
CORRECT = CEM(samples=128, rounds=2, elites=16, decay=1.0)
STAND = CEM(samples=64, rounds=2, elites=12, decay=1.0)


@dataclass(frozen=True)
class Preset:
    """How much a plan may cost: the optimisers of the first plan and of each replan, and steps between replans.

    verify: rounds of trials in the truth of the first plan and of each replan, 0 for none. correct: what searches on
    between two of them. stand: optimisers of the plans that keep the human up after the kick.
    """

    first: tuple[CEM | Gradient, ...]
    again: tuple[CEM | Gradient, ...]
    every: int
    verify: tuple[int, int] = (0, 0)
    correct: CEM | Gradient = CORRECT
    stand: tuple[CEM | Gradient, ...] = (STAND,)


# One population size throughout, because every size is compiled apart.
PRESETS = {
    "fast": Preset(
        (CEM(samples=128, rounds=4, elites=16, decay=1.0),),
        (CEM(samples=64, rounds=1, elites=16, decay=1.0),),
        every=5,
    ),
    "balanced": Preset(
        (CEM(samples=256, rounds=10, elites=24, decay=1.0),),
        (CEM(samples=128, rounds=3, elites=24, decay=1.0),),
        every=4,
    ),
    "accurate": Preset(
        (CEM(samples=512, rounds=12, elites=32, decay=1.0), Gradient(steps=16, elites=32)),
        (CEM(samples=256, rounds=4, elites=32, decay=1.0),),
        every=2,
        verify=(4, 2),
    ),
}


def preset_of(name: str) -> Preset:
    """The preset of this name."""
    if name not in PRESETS:
        raise ValueError(f"preset is {name!r}, but must be one of {', '.join(PRESETS)}")
    return PRESETS[name]


def within(preset: Preset, seconds: float, measure: Callable[[Preset], tuple[float, float]]) -> Preset:
    """The preset with as many candidates as its first plan can try in `seconds`, and each replan in a fifth of them.

    measure: seconds of a first plan and of a replan with a preset, compilation left out.
    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise ValueError(f"budget is {seconds}, but must be a finite number of seconds > 0")
    fitting, first, again = preset, 1.0, 1.0
    for _ in range(3):
        took = measure(fitting)
        first, again = first * seconds / took[0], again * AGAIN * seconds / took[1]
        fitting = scaled(preset, first, again)
    return fitting


def scaled(preset: Preset, first: float, again: float) -> Preset:
    """The preset with so many times the candidates in its first plan and in each replan.

    Candidates a round and rounds share the factor evenly; what is tried in the truth stays. All rounds keep the same
    number of elites, because the plans hand them on.
    """
    stages = (preset.first, first), (preset.again, again)
    sizes = [_size(each, factor) for stage, factor in stages for each in stage if isinstance(each, CEM)]
    elites = max(2, min(size // 4 for size, _ in sizes))

    def fit(each: CEM | Gradient, factor: float) -> CEM | Gradient:
        most = min(each.elites, elites)
        if isinstance(each, Gradient):
            return replace(each, elites=most, steps=max(1, round(factor * each.steps)))
        samples, rounds = _size(each, factor)
        return replace(each, samples=samples, rounds=rounds, elites=most)

    found = [tuple(fit(each, factor) for each in stage) for stage, factor in stages]
    return replace(preset, first=found[0], again=found[1])


def _size(optimizer: CEM, factor: float) -> tuple[int, int]:
    """Candidates a round and rounds for so many times the candidates."""
    rounds = max(1, round(math.sqrt(factor) * optimizer.rounds))
    return max(8, round(factor * optimizer.samples * optimizer.rounds / rounds)), rounds
