"""Key poses and their refinement: nothing is lost between numbers, poses and file; worse kicks cost more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from larp_model.errors import InputError
from larp_model.scene import Scene
from tasks import refine
from tasks.motions import key_poses
from tasks.motions.references import Reference


def test_key_poses_survive_their_file(tmp_path: Path) -> None:
    poses = key_poses.load()
    (tmp_path / "poses.json").write_text(key_poses.dumps(poses))
    assert key_poses.load(tmp_path / "poses.json") == poses
    assert key_poses.FILE.read_text() == key_poses.dumps(poses)


def test_numbers_say_all_that_is_searched() -> None:
    poses = key_poses.load()
    again = refine.with_numbers(poses, refine.numbers(poses))
    np.testing.assert_allclose(refine.numbers(again), refine.numbers(poses), atol=1e-9)
    other = refine.with_numbers(poses, refine.numbers(poses) + 1.0)
    # To the file's three decimals of the smallest spread.
    np.testing.assert_allclose(refine.numbers(other), refine.numbers(poses) + 1.0, atol=0.0006 / refine.LEAN)
    assert other.times == poses.times


def test_a_missed_ball_and_a_fall_cost_more_than_the_kick(scene: Scene, reference: Reference) -> None:
    kick = reference.states[None, : refine.WATCHED + 1]
    missed, fallen = kick.copy(), kick.copy()
    missed[:, :, -1] = missed[:, :1, -1]
    fallen[:, 150:, :-1, 2] -= 0.7
    costs = [refine.costs(scene, states) for states in (kick, missed, fallen)]
    total = [sum(float(cost[0]) for cost in named.values()) for named in costs]
    assert costs[0]["missed"][0] == 0.0 and costs[1]["missed"][0] > 0.0
    assert costs[0]["fell"][0] == 0.0 and costs[2]["fell"][0] > 0.0
    assert total[0] < 5.0 < min(total[1:])


def test_only_the_first_kick_is_undisturbed(scene: Scene) -> None:
    shift, noise = refine.disturbances(np.random.default_rng(0), scene, 3, 1.0)
    assert not shift[0].any() and not noise[0].any()
    assert shift[1:].any(axis=1).all() and noise[1:].any(axis=(1, 2, 3)).all()
    assert not noise[:, refine.STRIKE[1] :].any()


@pytest.mark.parametrize(("name", "value"), [("rounds", 0), ("population", 3), ("kicks", 0)])
def test_refinement_refuses_by_name(name: str, value: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"{name} is {value}"):
        refine.main(tmp_path / "poses.json", **{name: value})
    assert not list(tmp_path.iterdir())
