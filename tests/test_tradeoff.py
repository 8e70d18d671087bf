"""Promises of the trade-off: which points it measures, what the front is, and when a preset is beaten."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpc import CEM
from tasks import kick
from tasks.benchmarks import optimizers, report, tradeoff
from tasks.benchmarks.tradeoff import Point
from tasks.presets import PRESETS, Preset, Seconds, scaled

figure = st.floats(0.01, 100.0)
rows = st.lists(
    st.builds(lambda time, miss: {"planning_seconds": time, "mean_truth_error_m": miss}, figure, figure), min_size=1
)


def better(one: report.Row, other: report.Row) -> bool:
    """Return whether one is at least as good in both figures, and better in one of them."""
    pairs = [(one[name], other[name]) for name in ("planning_seconds", "mean_truth_error_m")]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def test_at_least_forty_points_are_measured_the_presets_among_them() -> None:
    names = [point.name for point in tradeoff.points()]
    assert len(names) == len(set(names)) >= 40
    assert {Point(preset).name for preset in PRESETS.values()} <= set(names)
    assert {point.family for point in tradeoff.points()} == set(tradeoff.FAMILIES)


@given(rows)
def test_the_front_holds_just_what_no_other_point_beats(found: list[report.Row]) -> None:
    front = tradeoff.front(found)
    assert not any(better(other, row) for row in front for other in found)
    left = [row for row in found if row not in front]
    assert all(any(better(other, row) for other in front) for row in left)


@given(rows)
def test_what_stands_on_the_front_is_never_beaten(found: list[report.Row]) -> None:
    assert not any(tradeoff.beaten(row, found) for row in tradeoff.front(found))


def test_a_point_is_beaten_only_by_what_is_a_tenth_better_in_both() -> None:
    row = {"planning_seconds": 1.0, "mean_truth_error_m": 0.1}
    others = [
        {"planning_seconds": time, "mean_truth_error_m": miss}
        for time, miss in ((0.89, 0.089), (0.91, 0.05), (0.5, 0.091))
    ]
    assert tradeoff.beaten(row, others) == others[:1]


def test_a_point_is_measured_and_drawn(tmp_path: Path) -> None:
    search = (CEM(samples=16, rounds=1, elites=4),)
    point = Point(Preset(search, search, interval=40), "mujoco", 4)
    row = tradeoff.measure(kick.Kick.standard(substeps=4), point, None, targets=2, seed=0)
    assert row["point"] == "mujoco 4: CEM 16x1 / CEM 16x1 every 40" and row["family"] == "mujoco"
    assert len(row["truth_errors_m"]) == 2
    assert row["planning_seconds"] >= row["plan_seconds"] > 0.0
    report.write_picture(tmp_path / "front.png", tradeoff.picture([row], {row["point"]: "some"}, 2))
    assert (tmp_path / "front.png").stat().st_size > 10_000
    table = tradeoff.table_of([row], {row["point"]: "some"})
    assert "**some** mujoco 4" in report.markdown(table)


def test_ways_to_search_are_fitted_into_the_time_measured_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []

    def fifth(preset: Preset, seconds: float, measure: object) -> Preset:
        given.append(seconds)
        return scaled(preset, Seconds(0.2, 0.2, 0.2))

    monkeypatch.setattr("tasks.session.within", fifth)
    row = optimizers.compare(kick.Kick.standard(substeps=4), "Gauss-Newton, differences", None, 0.3, targets=1, seed=0)
    assert given == [0.3] and row["plan_seconds"] > 0.0
    assert "Gauss-Newton, differences (GN 24x2 " in report.markdown(optimizers.table_of([row], 0.3))
    assert all(Point(Preset(*way, interval=5)).name for way in optimizers.WAYS.values())
