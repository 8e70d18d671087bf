"""Promises of the presets: their names, and how they are fitted into a time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import pytest

from larp_model.errors import InputError
from mpc import CEM, GaussNewton, Optimizer
from mpc.search import Problem, Search
from tasks.presets import PRESETS, Preset, PresetName, Seconds, changed, preset_of, scaled, within


def test_the_command_line_offers_every_preset() -> None:
    assert get_args(PresetName) == tuple(PRESETS)


def candidates(stages: tuple[Optimizer, ...]) -> int:
    """Return the number of candidates of all rounds of CEM and Gauss-Newton, without the steps' dampings."""
    rounds = [sum(each.sizes) for each in stages if isinstance(each, CEM)]
    return sum(rounds) + sum(each.rounds * each.directions for each in stages if isinstance(each, GaussNewton))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("factor", [0.01, 0.3, 1.0, 4.0])
def test_a_scaled_preset_tries_so_many_times_the_candidates(name: str, factor: float) -> None:
    preset = PRESETS[name]
    found = scaled(preset, Seconds(factor, factor, factor))
    for before, after in ((preset.first, found.first), (preset.replan, found.replan)):
        assert candidates(after) == pytest.approx(max(8, factor * candidates(before)), rel=0.35)


@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_a_preset_within_a_time_takes_that_time(seconds: float) -> None:
    def measure(preset: Preset) -> Seconds:
        return Seconds(*(0.01 + 2e-3 * candidates(each) for each in (preset.first, preset.replan, preset.recovery)))

    found = measure(within(PRESETS["balanced"], seconds, measure))
    assert found.first == pytest.approx(seconds, rel=0.1)
    assert found.replan == pytest.approx(0.2 * seconds, rel=0.1)
    assert found.recovery <= 0.22 * seconds


def test_the_first_plan_and_its_feedback_share_a_time_and_feedback_takes_no_more_than_half_of_it() -> None:
    def measure(preset: Preset) -> Seconds:
        first, replan, recovery = (
            0.01 + 2e-3 * candidates(each) for each in (preset.first, preset.replan, preset.recovery)
        )
        return Seconds(first, replan, recovery, 0.2 if preset.feedback else 0.0)

    for seconds, has_feedback in ((0.3, False), (0.5, True), (2.0, True)):
        fitting = within(PRESETS["balanced"], seconds, measure)
        assert fitting.feedback == has_feedback
        found = measure(fitting)
        assert found.first + found.feedback == pytest.approx(seconds, rel=0.1)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_that_is_no_time_is_refused(seconds: float) -> None:
    with pytest.raises(InputError, match="budget"):
        within(PRESETS["fast"], seconds, lambda preset: Seconds(1.0, 1.0, 1.0))


def test_a_budget_below_what_the_preset_can_do_says_what_the_least_is() -> None:
    def measure(preset: Preset) -> Seconds:
        return Seconds(*(0.01 + 2e-3 * candidates(each) for each in (preset.first, preset.replan, preset.recovery)))

    with pytest.raises(InputError, match=r"budget is 0\.02 s, but the least .* 0\.026 s"):
        within(PRESETS["balanced"], 0.02, measure)


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="fast, balanced, accurate"):
        preset_of("quick")


def test_any_field_of_a_preset_can_be_changed_by_its_name() -> None:
    found = changed(PRESETS["fast"], ["interval=2", "replan.0.rounds=3", "verify=(4, 2)", "tolerance=1"])
    assert (found.interval, found.verify, found.tolerance) == (2, (4, 2), 1)
    assert found.replan == (GaussNewton(rounds=3), *PRESETS["fast"].replan[1:]) and found.first == PRESETS["fast"].first


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("interval", "must be NAME=VALUE"),
        ("interval=often", "must be NAME=VALUE"),
        ("interval=2.5", "what it changes is 4"),
        ("intervl=2", "did you mean 'interval'"),
        ("every=2", "every is called interval now"),
        ("again.0.rounds=3", "again is called replan now"),
        ("replan.2.rounds=3", "must be one of 0"),
        ("replan.0=3", "what it changes is GaussNewton"),
        ("replan.0.round=3", "did you mean 'rounds'"),
        ("interval.more=2", "'more'"),
    ],
)
def test_a_change_that_makes_no_sense_is_refused_by_name(change: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        changed(PRESETS["fast"], [change])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("interval=0", "interval is 0, but must be an integer of at least 1"),
        ("interval=-3", "interval is -3"),
        ("candidates=0", "candidates is 0"),
        ("verify=(2,)", r"verify is \(2,\), but must be two integers of at least 0"),
        ("verify=('a', 1)", "verify is "),
        ("verify=(1, -1)", "verify is "),
        ("tolerance=-1.0", "tolerance is -1.0"),
        ("tolerance=1e999", "tolerance is inf"),
        ("replan.0.rounds=0", "rounds: got 0, needs at least 1"),
        ("first=()", r"first is \(\), but must be a tuple of at least one optimiser"),
        ("first=(1,)", "first holds 1, which is no optimiser"),
    ],
)
def test_a_change_to_what_no_plan_can_be_made_with_is_refused_by_name(change: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        changed(PRESETS["fast"], [change])


def test_an_optimiser_that_cannot_be_compared_is_refused_by_name() -> None:
    @dataclass
    class Mine:
        elites = 1
        differentiates = False
        terminal = False

        def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
            return search

    with pytest.raises(InputError, match="first holds a Mine that cannot be hashed: make it a frozen dataclass"):
        replace(PRESETS["fast"], first=(Mine(),))


def test_feedback_that_is_neither_on_nor_off_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="feedback is 1, but must be True or False"):
        replace(PRESETS["fast"], feedback=1)  # type: ignore[arg-type]
