"""What the planner tries in the truth is what happens there, starts where the kick does and leads to the targets."""

import numpy as np
import pytest

from larp_model.bodies import human_and_ball
from larp_model.meeting import first_contacts
from larp_model.truth.mujoco import SUBSTEPS, Truth
from tasks import tried
from tasks.data import CONTACT_STEPS
from tasks.kick import Kick
from tasks.tried import tried_by_many, tried_episodes


@pytest.fixture(scope="module")
def task() -> Kick:
    return Kick.standard()


def test_what_is_tried_is_what_happens_in_the_truth(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "STEPS", tried.GaussNewton(rounds=1, directions=6))
    episodes = tried_episodes(task, kicks=2, each=5, seed=3)
    assert episodes.states.shape == (10, task.horizon + 1, len(task.scene.links), 13)
    after, finite = Truth(task.scene, 10, SUBSTEPS).rollout(episodes.states[:, 0], episodes.controls)
    assert finite.all()
    np.testing.assert_allclose(after, episodes.states[:, 1:], atol=1e-3)
    human = task.human
    np.testing.assert_allclose(episodes.states[:, 0, human], task.start()[human][None].repeat(10, 0), atol=1e-6)


def test_no_kick_is_begun_after_the_time_is_up(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "STEPS", tried.GaussNewton(rounds=1, directions=6))
    assert len(tried_episodes(task, kicks=50, each=4, seed=3, seconds=0.0).states) == 4


def test_the_balls_that_are_tried_fly_where_targets_are(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "STEPS", tried.GaussNewton(rounds=3, directions=12))
    episodes = tried_episodes(task, kicks=3, each=1000, seed=4)
    velocity = episodes.states[:, -1, task.ball, 7:9]
    bearing = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))
    struck = np.linalg.norm(velocity, axis=-1) > 3.0
    assert struck.mean() > 0.9 and np.ptp(bearing[struck]) > 10.0


def test_many_humans_of_every_size_strike_their_balls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "STEPS", tried.GaussNewton(rounds=1, directions=6))
    scene = human_and_ball(self_contact=True)
    episodes, dropped = tried_by_many(scene, kicks=2, each=8, seed=5)
    again, _ = tried_by_many(scene, kicks=2, each=8, seed=5)
    np.testing.assert_array_equal(episodes.states, again.states)
    assert episodes.steps == CONTACT_STEPS and 0 < len(episodes.states) + dropped <= 2 * 8 * tried.CONTACTS
    heights = np.unique(episodes.morphology[:, : len(scene.bodies[0].links), 0].sum(axis=1).round(4))
    assert len(heights) == 2
    assert (first_contacts(scene.between, episodes) >= 0).mean() > 0.7


def test_a_kick_that_drives_no_ball_away_is_none(task: Kick, monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    monkeypatch.setattr(tried, "SPEED", 100.0)
    assert tried.bent_kick(task.scene, random) is None
