"""The viewer: meshes, recordings, the page's address, the replay and the picture."""

import base64
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from page_clients import eventually
from scipy.spatial.transform import Rotation

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.state import ORIENTATION, POSITION, VELOCITY
from viewer import LivePage, Recording, check_film, kick_picture, nearest_approach, write_film, write_html
from viewer.camera import PictureCamera
from viewer.film import frames
from viewer.live_data import LiveData, StateUpdate
from viewer.panel import Panel
from viewer.scene_view import Mesh, SceneView, football_meshes, unit_meshes

SCENE = human_and_ball()


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A rigid statue, and a ball that is struck at 0.1 s and passes 0.2 m to the left of the target."""
    states = np.zeros((60, len(SCENE.links), 13))
    states[..., ORIENTATION] = 1.0, 0.0, 0.0, 0.0
    states[:, :-1, POSITION] = np.linspace((0.0, -0.3, 0.1), (0.0, 0.3, 1.7), len(SCENE.links) - 1)
    flown = np.maximum(np.arange(60) * SCENE.dt - 0.1, 0.0)
    states[:, -1, POSITION] = np.stack([0.5 + 8.0 * flown, 0.0 * flown, 0.11 + flown], axis=-1)
    states[11:, -1, VELOCITY] = 8.0, 0.0, 1.0
    predicted = states[5:40] + np.where(np.arange(13) == 1, 0.05, 0.0)
    target = np.array([2.5, -0.2, 0.36])
    return Recording(SCENE, states, target, predicted, 5, states, "A <kick>", {"speed": "8 m/s"})


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(port=0) as page:
        yield page


def volume(*meshes: Mesh) -> float:
    """Return the volume that closed meshes enclose together, by the divergence theorem."""
    return sum(float(np.linalg.det(vertices[faces].astype(float)).sum()) / 6.0 for vertices, faces in meshes)


def test_capsules_are_made_of_a_ball_and_a_tube_of_their_size() -> None:
    (ball, faces), (tube, sides) = unit_meshes()
    assert 0.97 < volume((ball, faces)) / (4.0 / 3.0 * np.pi) < 1.0
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(tube[:, :2], axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(np.abs(tube[:, 2]), 0.5)
    outwards = np.cross(tube[sides[:, 1]] - tube[sides[:, 0]], tube[sides[:, 2]] - tube[sides[:, 0]])
    assert ((outwards * tube[sides[:, 0]]).sum(axis=-1) > 0.0).all()
    edges = {(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert len(edges) == 3 * len(faces) and all((b, a) in edges for a, b in edges)


def test_capsules_are_drawn_where_their_links_are_and_unknown_ones_shrink_to_nothing(page: LivePage) -> None:
    scene, random = human_and_ball(), np.random.default_rng(3)
    state = random.standard_normal((len(scene.links), 13))
    state[:, ORIENTATION] /= np.linalg.norm(state[:, ORIENTATION], axis=-1, keepdims=True)
    state[2] = np.nan
    view = SceneView(page._server, scene, "/drawn")
    view.update(state)
    capsules = view.capsules
    assert capsules is not None
    ends_sizes, tube_sizes = capsules.ends.batched_scales, capsules.tubes.batched_scales
    assert ends_sizes is not None and tube_sizes is not None
    links = len(scene.body("human").links)
    for row, link in enumerate(scene.body("human").links):
        ends, tube = ends_sizes[[row, row + links]], tube_sizes[row]
        if row == 2:
            assert not ends.any() and not tube.any()
            continue
        np.testing.assert_allclose(ends, link.radius, rtol=1e-6)
        np.testing.assert_allclose(tube, (link.radius, link.radius, link.length), rtol=1e-6)
        turned = Rotation.from_quat(state[row, ORIENTATION], scalar_first=True)
        reach = turned.apply(0.5 * link.length * np.array(link.axis))
        places = state[row, POSITION] + np.array([-1.0, 1.0])[:, None] * reach
        np.testing.assert_allclose(capsules.ends.batched_positions[[row, row + links]], places, atol=1e-6)
        np.testing.assert_allclose(capsules.tubes.batched_positions[row], state[row, POSITION], atol=1e-6)
        along = Rotation.from_quat(capsules.tubes.batched_wxyzs[row], scalar_first=True).apply((0.0, 0.0, link.length))
        np.testing.assert_allclose(along, 2.0 * reach, atol=1e-6)


def test_football_is_a_sphere_of_two_colours() -> None:
    white, dark = football_meshes(0.11)
    for vertices, _ in (white, dark):
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.11, rtol=1e-5)
    exact = 4.0 / 3.0 * np.pi * 0.11**3
    assert 0.98 * exact < volume(white, dark) < exact
    assert 0.2 < volume(dark) / exact < 0.35  # the pentagons of a truncated icosahedron, seen from its centre


@given(st.floats(-2.0, 2.0), st.floats(0.01, 2.0), st.floats(0.0, 1.0))
def test_nearest_approach_lies_between_states(along: float, miss: float, offset: float) -> None:
    path = np.arange(-3.0, 4.0)[:, None] * [1.0, 0.0, 0.0] + [offset, 0.0, 0.0]
    target = np.array([along, miss, 0.0])
    approach = nearest_approach(path, target)
    assert approach.distance == pytest.approx(miss)
    np.testing.assert_allclose(approach.point, [along, 0.0, 0.0], atol=1e-9)
    assert path[approach.row, 0] <= along + 1e-9


def test_nearest_approach_of_a_resting_ball() -> None:
    assert nearest_approach(np.zeros((5, 3)), np.array([0.0, 3.0, 4.0])).distance == pytest.approx(5.0)
    with pytest.raises(InputError, match=r"path has shape \(0, 3\)"):
        nearest_approach(np.zeros((0, 3)), np.zeros(3))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("states", np.zeros((3, 2, 13))),
        ("states", np.full((3, len(SCENE.links), 13), np.nan)),
        ("predicted", np.zeros((0, len(SCENE.links), 13))),
        ("reference", np.zeros((len(SCENE.links), 13))),
        ("estimated", np.full((3, len(SCENE.links), 13), np.inf)),
        ("predicted_start", 60),
        ("target", np.array([1.0, np.nan, 0.0])),
        ("traced", 14),
    ],
)
def test_recording_refuses_nonsense(recording: Recording, field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"^{field} "):
        replace(recording, **{field: value})  # type: ignore[arg-type]


def test_prediction_is_aligned_with_the_truth(recording: Recording) -> None:
    assert recording.predicted is not None and recording.predicted_path is not None
    for row in (4, 40):
        assert recording.predicted_at(row) is None
    for row in (5, 39):
        expected = recording.predicted_at(row)
        assert expected is not None
        np.testing.assert_allclose(expected[:, 0], recording.states[row, :, 0])


def test_an_estimate_is_drawn_beside_the_truth_and_nowhere_else(page: LivePage, recording: Recording) -> None:
    page.finish(replace(recording, estimated=recording.states[:30]))
    stage = page._stage
    assert stage is not None
    ghost = stage.lane._ghosts["estimate"]._root
    for row, visible in ((10, True), (50, False)):
        page.panel.playing = False
        page.panel.move(row * SCENE.dt - page.panel.time)
        eventually(lambda: page._drawn_frame is not None and page._drawn_frame[0] == row)  # noqa: B023
        assert ghost.visible == visible


def test_page_follows_and_plays(page: LivePage, recording: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    page.begin(recording.scene, recording.target)
    began = time.monotonic()
    for row, state in enumerate(recording.states):
        page.update(state, recording.predicted if row == 4 else None, row * SCENE.dt)
    assert time.monotonic() - began < 0.5, "update must not wait for the drawing"
    page.finish(recording)
    time.sleep(0.2)
    assert page._recording is recording and page._drawn_frame is not None
    page.close()
    assert not page._thread.is_alive()
    assert capsys.readouterr().out == ""


@given(st.integers(1, 6), st.integers(1, 8))
def test_states_that_come_in_bursts_are_drawn_in_order_and_never_far_behind(burst: int, pictures: int) -> None:
    states = np.zeros((10 * burst, len(SCENE.links), 13))
    states[:, :, 0] = np.arange(len(states))[:, None]
    live, came = LiveData(states[0], 0.0), 0
    for _ in range(10):
        for _ in range(burst):
            live.updates.append(StateUpdate(states[came], came * SCENE.dt, None, None))
            came += 1
        for _ in range(pictures):
            waited = len(live.updates)
            live.state_is_new = False
            live.advance()
            assert live.state_is_new == (waited > 0) and len(live.updates) < max(waited, 1)
        assert len(live.updates) <= max(burst, 5 * burst // pictures)
    np.testing.assert_array_equal(np.array(live.path)[:, 0, 0], np.arange(came - len(live.updates)))


def test_update_needs_a_scene(page: LivePage, recording: Recording) -> None:
    with pytest.raises(InputError, match="before begin"):
        page.update(recording.states[0], None, 0.0)


def test_clock_runs_over_and_survives_nonsense(page: LivePage) -> None:
    panel = Panel(page._server.gui, lambda name, client: None, lambda: None)
    panel.play(1.0, 0.01)
    assert panel.advance(0.25) == pytest.approx(0.25)
    assert panel.advance(0.25) == pytest.approx(0.5)
    assert panel.advance(5.0) == 1.0
    assert panel.advance(0.0) == 0.0
    for value in (np.nan, np.inf, -1.0):
        panel._time.value = value  # type: ignore[misc]
        assert panel.advance(0.25) == pytest.approx(0.25)


def test_replay_stands_alone(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "kick.html"
    write_html(recording, path)
    assert [file.name for file in path.parent.iterdir()] == ["kick.html"]
    page = path.read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", page)
    assert "<title>A &lt;kick&gt;</title>" in page and "speed: 8 m/s" in page
    assert "nearest to the target: 20.0 cm" in page
    data = re.search(r'__VISER_EMBED_DATA__="([A-Za-z0-9+/=]+)"', page)
    assert data is not None and len(base64.b64decode(data[1])) > 10_000
    assert path.stat().st_size < 3_000_000


def test_failed_replay_leaves_nothing(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_html(recording, tmp_path / "kick.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("case", ["full", "bare", "never struck", "worthless costs"])
def test_picture_shows_something(recording: Recording, tmp_path: Path, case: str) -> None:
    costs: dict[str, list[float]] | None = {"ball": [3.0, 1.0, 0.1], "effort": [0.0, 0.2, np.inf]}
    if case == "bare":
        recording, costs = (
            replace(recording, predicted=None, predicted_start=0, reference=None, title=""),
            None,
        )
    if case == "never struck":
        recording = replace(recording, states=np.repeat(recording.states[:1], 8, axis=0))
    if case == "worthless costs":
        costs = {"ball": [0.0, np.inf], "effort": []}
    kick_picture(recording, costs, tmp_path / "kick.png")
    pixels = imread(tmp_path / "kick.png")[..., :3]
    assert pixels.shape[:2] == (1000, 1800)
    inked = (pixels < 0.95).any(axis=-1)
    quarters = [half for rows in np.array_split(inked, 2) for half in np.array_split(rows, 2, axis=1)]
    assert all(0.005 < quarter.mean() < 0.5 for quarter in quarters)


def test_picture_names_no_cost_that_has_no_curve(recording: Recording, tmp_path: Path) -> None:
    costs = {"ball": [3.0, 1.0, 0.1]}
    kick_picture(recording, costs, tmp_path / "shown.png")
    kick_picture(recording, costs | {"upright": [0.0, 0.0, 0.0], "lost": [np.inf]}, tmp_path / "besides.png")
    np.testing.assert_array_equal(imread(tmp_path / "shown.png"), imread(tmp_path / "besides.png"))


def test_the_film_goes_slowly_up_to_the_target_and_shows_what_moves(recording: Recording) -> None:
    pictures = list(frames(recording, (320, 180), rate=10.0))
    passed = nearest_approach(recording.path, recording.target).row * SCENE.dt + 0.1
    assert len(pictures) == pytest.approx(10.0 * (4.0 * passed + recording.duration - passed), abs=2)
    assert pictures[0].shape == (180, 320, 3) and (pictures[0] != pictures[-1]).any()
    assert np.unique(pictures[0].reshape(-1, 3), axis=0).shape[0] > 50, "it is not blank"


def test_the_camera_is_as_near_as_it_can_be_with_all_points_in_its_picture() -> None:
    points = np.random.default_rng(0).uniform(-1.0, 2.0, (50, 3))
    found = abs(PictureCamera.of(points, 0.5)(points)) / (1.0, 0.5)
    assert found.max() == pytest.approx(1.0)


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_is_written_in_the_format_of_its_name(suffix: str, recording: Recording, tmp_path: Path) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / f"kick{suffix}"
    write_film(recording, path, (160, 90), rate=10.0)
    begin = path.read_bytes()[:12]
    assert begin[:6] == b"GIF89a" if suffix == ".gif" else begin[4:8] == b"ftyp"
    assert path.stat().st_size > 10_000
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_film_of_no_known_format_is_refused() -> None:
    with pytest.raises(InputError, match=r"video is 'kick.avi', but its name must end in .mp4 or .gif"):
        check_film("kick.avi")


def test_a_file_is_not_handed_to_a_client_that_has_left(page: LivePage, recording: Recording) -> None:
    gone = Mock(client_id=7)
    page.finish(recording)
    page.files = lambda kind, recording: ("kick.html", b"<!doctype html>")
    page._clients.download(gone, "html", page.recording, page.files)
    assert page._clients._download_lock.acquire(timeout=30.0), "the next file may be made"
    gone.send_file_download.assert_not_called()
