"""Candidates of the planner are what happens in the ground truth, start as the kick does and reach the targets."""

import numpy as np
import pytest

from larp_model.engines.mujoco import SUBSTEPS, Truth
from mpc import GaussNewton
from tasks.episodes import candidates
from tasks.episodes.candidates import candidate_episodes
from tasks.kick import Kick


@pytest.fixture(scope="module")
def task() -> Kick:
    return Kick.standard()


def test_what_is_tried_is_what_happens_in_the_truth(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "OPTIMIZER", GaussNewton(rounds=1, directions=6))
    episodes = candidate_episodes(task, kicks=2, per_plan=5, seed=3)
    assert episodes.states.shape == (10, task.horizon + 1, len(task.scene.links), 13)
    after, finite = Truth(task.scene, 10, SUBSTEPS).rollout(episodes.states[:, 0], episodes.controls)
    assert finite.all()
    np.testing.assert_allclose(after, episodes.states[:, 1:], atol=1e-3)
    first = task.start()[task.human]
    np.testing.assert_allclose(episodes.states[:, 0, task.human], first[None].repeat(10, 0), atol=1e-6)


def test_no_kick_is_begun_after_the_time_is_up(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "OPTIMIZER", GaussNewton(rounds=1, directions=6))
    assert len(candidate_episodes(task, kicks=50, per_plan=4, seed=3, seconds=0.0).states) == 4


def test_the_balls_that_are_tried_fly_where_targets_are(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "OPTIMIZER", GaussNewton(rounds=3, directions=12))
    episodes = candidate_episodes(task, kicks=3, per_plan=1000, seed=4)
    velocity = episodes.states[:, -1, task.ball, 7:9]
    bearing = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))
    struck = np.linalg.norm(velocity, axis=-1) > 3.0
    assert struck.mean() > 0.9 and np.ptp(bearing[struck]) > 10.0
