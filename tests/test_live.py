"""A task on its page, without a browser: settings stay within the offer, and requests are handled."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from larp_model import state as packed
from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from mpc import PlanInfo
from mpc.loop import Execution, PlanRecord
from mpc.realtime import MARGIN
from tasks.kick import Kick
from tasks.live import PushableWorld, initial_state, load_recording
from tasks.live_choices import (
    DELAYS,
    REAL_TIME,
    ROLLS,
    SPOTS,
    TARGETS,
    WORLD_WAITS,
    Choices,
    latency_of,
    weights_for,
)
from tasks.live_figures import plan_lines
from tasks.presets import PRESETS
from tasks.run import last_plan
from viewer import LivePage, PageClosedError, Push
from viewer.camera import VIEWS, PictureCamera, View
from viewer.handles import Handles
from viewer.recording import mask_unpredicted
from viewer.stage import GOAL_CORNERS

SCENE = human_and_ball()


@pytest.fixture(scope="module")
def kick() -> Kick:
    return Kick.standard(substeps=4)


@pytest.fixture
def page(kick: Kick) -> Iterator[LivePage]:
    choices = Choices({"embedded": lambda: kick}, PRESETS, ("larp", "mujoco"), weights_for(None))
    with LivePage(port=0, offer=choices.offer(kick)) as page:
        page.begin(kick.scene, np.array([4.0, 0.0, 0.5]), state=kick.start())
        yield page


def test_the_first_settings_are_the_defaults(page: LivePage, kick: Kick) -> None:
    settings = page.settings
    assert settings.target == (4.0, 0.0, 0.5) and settings.spot == settings.roll == (0.0, 0.0)
    assert (settings.preset, settings.dynamics, settings.weights) == (next(iter(PRESETS)), "larp", "none")
    assert (settings.sensors, settings.delay) == ("perfect", REAL_TIME)
    assert dict(settings.terms) == {term.name: term.weight for term in kick.terms}
    np.testing.assert_array_equal(initial_state(kick, settings), kick.start())


@pytest.mark.parametrize(
    ("name", "box"), [("target", TARGETS), ("spot", SPOTS), ("roll", ROLLS)], ids=["target", "spot", "roll"]
)
@pytest.mark.parametrize("place", [(1e6, -1e6, 1e6), (-1e6, 1e6, -1e6), (np.nan, np.inf, -np.inf)])
def test_whatever_is_dragged_stays_within_what_is_offered(
    name: str, box: tuple[tuple[float, ...], ...], place: tuple[float, ...], page: LivePage
) -> None:
    handles = page._handles
    assert isinstance(handles, Handles)
    handles._set_value(name, np.array(place))
    value = np.array(getattr(page.settings, name))
    assert (value >= np.array(box[0]) - 1e-12).all() and (value <= np.array(box[1]) + 1e-12).all()


def test_a_ball_can_be_dragged_while_a_plan_is_shown(page: LivePage) -> None:
    handles = page._handles
    assert isinstance(handles, Handles)

    def drag(number: int) -> None:
        handles._set_value("roll", handles.ball_position + np.array([0.3 + 0.001 * number, 0.0, 0.0]))

    def show(number: int) -> None:
        handles.show_all(number % 2 == 0)

    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(action, number) for number in range(300) for action in (drag, show)]
        assert [job.exception() for job in jobs] == [None] * len(jobs)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 1e9, "much", None])
def test_whatever_a_client_sends_weights_stay_within_what_is_offered(value: object, page: LivePage) -> None:
    page.panel._terms["effort"]._impl.value = value
    assert 0.0 <= page.settings.terms["effort"] <= 5.0 * 0.5


@pytest.mark.parametrize("name", ["preset", "dynamics", "weights", "reference", "sensors", "delay"])
@pytest.mark.parametrize("value", ["never heard of", 3, None])
def test_a_choice_that_is_not_offered_is_the_default(name: str, value: object, page: LivePage) -> None:
    default = getattr(page.settings, name)
    page.panel._controls[name]._impl.value = value
    assert getattr(page.settings, name) == default


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_plans_are_expected_after_their_delay(delay: str, speed: float) -> None:
    latency = latency_of(delay, 0.01, [0.04, 0.06, 0.3], speed, horizon=48)
    if delay == WORLD_WAITS:
        assert latency is None
        return
    assert latency is not None
    expected = 6 * speed + MARGIN if delay == REAL_TIME else float(delay.removesuffix(" ms")) / 10.0
    assert latency.lead == np.ceil(expected)
    latency.close()


def test_the_world_waits_for_plans_that_take_longer_than_their_horizon() -> None:
    assert latency_of(REAL_TIME, 0.01, [0.5], speed=1.0, horizon=48) is None
    assert latency_of(REAL_TIME, 0.01, [0.5], speed=0.5, horizon=48) is not None


def test_figures_count_the_replans_that_missed_their_deadline() -> None:
    info = PlanInfo(1.0, {"effort": 1.0}, np.zeros((1, 1, 13)), [], np.zeros(0), 8, 8, 0, np.zeros(0), 0.02, 0.0)
    records = [
        PlanRecord(step, 0, np.zeros((1, 13)), Mock(), info, requested=requested, received=received, error=error)
        for step, requested, received, error in ((0, 0, 0, 0.0), (8, 4, 8, 0.002), (16, 12, 19, np.nan))
    ]
    lines = plan_lines(Execution([], [], records), 0.01)
    assert lines[0].endswith("11 a second")
    assert "late: 1 of 2 replans" in lines
    assert "begun 40 ms after they are requested, from a prediction that is 2.0 mm off" in lines
    assert not any("late" in line for line in plan_lines(Execution([], [], records[:1]), 0.01))


def test_what_is_compared_with_the_kick_is_the_last_plan_that_began_before_it() -> None:
    info = PlanInfo(1.0, {}, np.zeros((1, 1, 13)), [], np.zeros(0), 8, 8, 0, np.zeros(0), 0.02, 0.0)
    plans = [PlanRecord(step, 0, np.zeros((1, 13)), Mock(), info) for step in (0, 20, 40)]
    assert [last_plan(plans, contact).step for contact in (None, 41, 40, 20, 0)] == [40, 40, 20, 0, 40]


def test_a_drag_is_a_change_and_requests_are_handed_on_in_order(page: LivePage) -> None:
    changes = page.changes
    page.aim(np.array([3.0, 0.5, 0.4]))
    assert page.changes == changes + 1 and page.settings.target == (3.0, 0.5, 0.4)
    page.request("kick")
    page.request("push ball")
    assert [page.next_request(), page.next_request(), page.next_request()] == ["kick", "push ball", None]
    page.close()
    with pytest.raises(PageClosedError):
        page.next_request(10.0)


def test_a_paused_page_makes_a_kick_wait_until_a_step_is_requested(page: LivePage, kick: Kick) -> None:
    page.hold(0.0)
    page.update(kick.start(), None, 0.0)
    page.request("play")
    assert not page.playing
    held = threading.Thread(target=page.hold, args=(0.0,))
    held.start()
    held.join(0.2)
    assert held.is_alive()
    page.request("step")
    held.join(5.0)
    assert not held.is_alive()
    page.close()
    with pytest.raises(PageClosedError):
        page.hold(0.0)


@pytest.mark.parametrize("view", VIEWS)
def test_every_view_has_the_goal_and_the_target_in_its_picture(view: View, page: LivePage) -> None:
    stage, aspect = page._stage, 1.2
    assert stage is not None
    points = np.concatenate([GOAL_CORNERS, [page.settings.target]])
    assert (np.abs(stage.camera(view, aspect)(points)) <= (1.0, 1.0 / aspect)).all()


def test_a_push_changes_the_velocity_of_its_body_alone(kick: Kick) -> None:
    start, control = kick.start(), kick.reference.controls[:1]
    usual, pushed = PushableWorld(kick.scene, 4), PushableWorld(kick.scene, 4)
    for world in (usual, pushed):
        world.reset(start[None])
    pushed.pushes.append(Push("ball", (0.0, 2.0, 1.0)))
    apart = (pushed.step(control) - usual.step(control))[0, :, packed.VELOCITY]
    np.testing.assert_allclose(apart[-1, 1:], (2.0, 1.0), atol=0.15)
    assert abs(apart[:-1]).max() < 1e-6 and not pushed.pushes


def test_weights_that_are_chosen_come_first_and_none_can_be_had() -> None:
    assert weights_for(None) == {"none": None}
    assert list(weights_for(Path("runs/adapt/adapted.json"))) == ["adapted", "none"]


def test_a_kept_kick_of_another_scene_or_damaged_is_refused(kick: Kick, tmp_path: Path) -> None:
    summary = {"target": [4.0, 0.0, 0.5]}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    for damage in (lambda path: None, lambda path: path.write_bytes(b"PK"), other_scene):
        damage(tmp_path / "kick.npz")
        with pytest.raises(InputError, match=r"cannot be read|has shape"):
            load_recording(kick, tmp_path)


def other_scene(path: Path) -> None:
    np.savez(path, states=np.zeros((3, 2, 13)), predicted_states=np.zeros((2, 2, 13)), plan_step=0)


def test_a_prediction_is_shown_as_far_as_it_was_worked_out() -> None:
    states = np.zeros((6, len(SCENE.links), 13))
    states[:, :, 0] = np.minimum(np.arange(6), 3)[:, None]
    states[:, -1, 0] = np.arange(6)
    masked = mask_unpredicted(states)
    assert np.isfinite(masked[:4]).all() and np.isfinite(masked[:, -1]).all()
    assert np.isnan(masked[4:, :-1]).all()


@given(st.sampled_from(VIEWS), st.floats(0.3, 3.0), st.integers(0, 100))
def test_every_view_has_all_that_matters_in_its_picture(view: View, aspect: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-2.0, 4.0, (20, 3))
    camera = PictureCamera.of(points, 1.0 / aspect, view, 0.4 * aspect)
    found = np.abs(camera(points)) / (1.0, 1.0 / aspect)
    assert (camera.depth(points) > 0.0).all() and found.max() == pytest.approx(1.0, abs=1e-6)
