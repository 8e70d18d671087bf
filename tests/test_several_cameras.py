"""Several cameras: points from their rays, films that began at other times, and what does not fit together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import keypoint_files
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.files import arrays_of
from tasks.motions.references import embedded
from tasks.pose import camera as cameras
from tasks.pose import figure as figures
from tasks.pose import lift, metrics, physical, sources, synthetic_film
from tasks.pose.camera import Camera
from tasks.pose.figure import SHARED
from tasks.pose.points import POINTS, Keypoints, interpolated
from tasks.pose.synchronisation import match, resampled, synchronised
from tasks.pose.triangulation import triangulated
from tasks.pose.views import Views, places_in_all

SIZE = synthetic_film.SIZE
seeds = st.integers(0, 2**31)


def cameras_around(random: np.random.Generator, points: np.ndarray, count: int) -> list[Camera]:
    """Cameras that see the points from all sides, none of them opposite to another."""
    middle = points.mean(axis=(0, 1))
    turns = random.uniform(0.0, 2.0 * np.pi) + 2.3 * np.arange(count)
    around = np.stack([5.0 * np.cos(turns), 5.0 * np.sin(turns), random.uniform(-0.3, 1.0, count)], axis=-1)
    places = middle + around
    return [cameras.looking_at(place, middle, 800.0, SIZE) for place in places]


@pytest.fixture(scope="module")
def kick() -> np.ndarray:
    """Points (T, P, 3) [m] of the embedded kick, 100 frames a second."""
    reference, figure = embedded(human_and_ball()), figures.figure()
    points = physical.BodyPoints(figure.body, figure, np.zeros(SHARED))
    states = reference.states[:, : len(figure.body.links)]
    return np.asarray(points.points(states.astype(np.float32)), float)


def film_of(camera: Camera, points: np.ndarray, rate: float, began: float, seed: int = 0) -> Keypoints:
    """The film of points (T, P, 3) of 100 frames a second, by a camera that began some seconds later."""
    times = np.arange(began, (len(points) - 1) / 100.0, 1.0 / rate)
    shown = interpolated(points, 100.0, times)
    return synthetic_film.detected(np.random.default_rng(seed), camera, shown, rate)


def written(folder: Path, name: str, film: Keypoints, **changed: Any) -> Path:
    fields: dict[str, Any] = {"names": np.array(POINTS), "places": film.places, "confidence": film.confidence}
    fields |= {"rate": film.rate, "size": np.array(SIZE)} | changed
    np.savez(folder / f"{name}.npz", **fields)
    return folder / f"{name}.npz"


def calibration(folder: Path, **by_name: Camera) -> Path:
    """A file of Pose2Sim's with the cameras."""
    content = ""
    for name, camera in by_name.items():
        matrix = [[camera.focal, 0.0, 500.0], [0.0, camera.focal, 500.0], [0.0, 0.0, 1.0]]
        rotation = Rotation.from_matrix(camera.turn).as_rotvec()
        translation = -camera.turn @ camera.position
        content += f'[{name}]\nname = "{name}"\nsize = [1000.0, 1000.0]\nmatrix = {matrix}\ndistortions = [0.0, 0.0]\n'
        content += f"rotation = {rotation.tolist()}\ntranslation = {translation.tolist()}\nfisheye = false\n\n"
    (folder / "calib.toml").write_text(content.replace("distortions = [0.0, 0.0]\n", ""))
    return folder / "calib.toml"


def person(points: np.ndarray) -> dict[str, Any]:
    """One of AlphaPose's results, in COCO's order, of points (P, 3) in ours."""
    rows = keypoint_files.rows(points, keypoint_files.COCO, 17)
    rows[rows[:, 0] < 0.0] = 0.0
    return {"category_id": 1, "keypoints": rows.ravel().tolist(), "score": 2.5}


@pytest.mark.parametrize("frames", [1, 4, 5, 40])
def test_a_synthetic_film_has_as_many_frames_as_it_is_given(kick: np.ndarray, frames: int) -> None:
    camera = cameras_around(np.random.default_rng(0), kick, 1)[0]
    film = synthetic_film.detected(np.random.default_rng(1), camera, kick[:frames], 50.0)
    assert film.places.shape == (frames, len(POINTS), 2) and film.detected.any()


class TestTriangulation:
    @settings(max_examples=20)
    @given(seeds, st.integers(2, 5))
    def test_points_are_where_all_their_rays_meet(self, seed: int, count: int) -> None:
        random = np.random.default_rng(seed)
        points = random.uniform(-1.0, 1.0, (4, len(POINTS), 3)) + np.array([0.0, 0.0, 1.0])
        around = cameras_around(random, points, count)
        places = places_in_all(around, points)
        found, distances = triangulated(around, places, np.ones(places.shape[:3]), np.full(count, 4.0))
        np.testing.assert_allclose(found, points, atol=1e-6)
        assert np.abs(distances).max() < 1e-4

    def test_an_image_in_which_a_point_is_elsewhere_does_not_move_it(self) -> None:
        random = np.random.default_rng(3)
        points = random.uniform(-1.0, 1.0, (4, len(POINTS), 3)) + np.array([0.0, 0.0, 1.0])
        around = cameras_around(random, points, 4)
        places = places_in_all(around, points)
        places[:, 2, 5] += 150.0
        found, distances = triangulated(around, places, np.ones(places.shape[:3]), np.full(4, 4.0))
        np.testing.assert_allclose(found, points, atol=1e-6)
        np.testing.assert_allclose(distances[:, 2, 5], np.hypot(150.0, 150.0), rtol=1e-6)

    def test_rays_that_hardly_meet_know_no_depth_but_give_numbers(self) -> None:
        for seed in range(40):
            random = np.random.default_rng(seed)
            one = cameras.looking_at(random.normal(size=3) + np.array([0.0, 0.0, 4.0]), np.zeros(3), 800.0, SIZE)
            two = Camera(one.focal, one.centre, one.turn, one.position + 1e-3 * random.normal(size=3))
            places = random.uniform(200.0, 800.0, (3, 1, len(POINTS), 2)).repeat(2, axis=1)
            places[:, 1] += 1e-5 * random.normal(size=places[:, 1].shape)
            found, _ = triangulated([one, two], places, np.ones(places.shape[:3]), np.full(2, 4.0))
            assert np.isfinite(found).all()

    def test_a_point_that_only_one_camera_sees_is_not_known(self) -> None:
        random = np.random.default_rng(4)
        points = random.uniform(-1.0, 1.0, (3, len(POINTS), 3)) + np.array([0.0, 0.0, 1.0])
        around = cameras_around(random, points, 3)
        places = places_in_all(around, points)
        places[1, 1:, 7] = np.nan
        found, _ = triangulated(around, places, np.isfinite(places[..., 0]).astype(float), np.full(3, 4.0))
        assert np.isnan(found[1, 7]).all() and np.isfinite(found).sum() == found.size - 3


class TestTime:
    def test_a_film_at_its_own_times_is_itself_and_shows_nothing_before_and_after(self, kick: np.ndarray) -> None:
        film = film_of(cameras_around(np.random.default_rng(0), kick, 1)[0], kick, 50.0, 0.0)
        again = resampled(film, film.times, film.rate)
        np.testing.assert_allclose(again.places, film.places)
        np.testing.assert_array_equal(again.confidence, film.confidence)
        outside = resampled(film, np.array([-0.02, film.times[-1] + 0.02]), film.rate)
        assert not outside.detected.any() and np.isnan(outside.places).all()

    @pytest.mark.parametrize("began", [-0.5, 0.0, 0.316, 0.8])
    @pytest.mark.parametrize("rate", [25.0, 60.0, 240.0])
    def test_when_another_film_began_is_found_whatever_its_rate(
        self, kick: np.ndarray, began: float, rate: float
    ) -> None:
        one, two = cameras_around(np.random.default_rng(1), kick, 2)
        first, other = film_of(one, kick, 50.0, max(-began, 0.0)), film_of(two, kick, rate, max(began, 0.0), 1)
        found = match(first, one, [other], two)
        assert found.delay == pytest.approx(began, abs=0.015) and found.misfit < 0.1

    def test_the_same_person_is_found_in_another_film(self, kick: np.ndarray) -> None:
        one, two = cameras_around(np.random.default_rng(2), kick, 2)
        others = [film_of(two, kick + shift, 50.0, 0.1, 1) for shift in ((0.0, 0.0, 0.4), (0.0, 0.0, 0.0))]
        found = match(film_of(one, kick, 50.0, 0.0), one, others, two)
        assert found.person == 1 and found.delay == pytest.approx(0.1, abs=0.008)

    def test_films_of_which_none_shows_the_other_one_are_refused(self, kick: np.ndarray) -> None:
        one, two = cameras_around(np.random.default_rng(2), kick, 2)
        film = film_of(one, kick, 50.0, 0.0)
        nobody = Keypoints(np.full_like(film.places, np.nan), np.zeros_like(film.confidence), 50.0, SIZE)
        with pytest.raises(InputError, match="has nobody in it for 10 frames of the first film"):
            match(film, one, [nobody], two)


def test_a_figure_laid_over_two_films_is_nearer_than_over_one(kick: np.ndarray) -> None:
    around = cameras_around(np.random.default_rng(5), kick, 2)
    films = [
        film_of(camera, kick, 50.0, began, seed)
        for seed, (camera, began) in enumerate(zip(around, (0.2, 0.0), strict=True))
    ]
    true = interpolated(kick, 100.0, 0.2 + films[0].times)
    errors = []
    for views in (Views((films[0],), (around[0],)), synchronised(films, around, (0.0, -0.2))):
        lifted = lift.lift(views)
        points = figures.figure().all_points(lifted.pose, lifted.proportions)
        errors.append(metrics.position_errors(points, true))
    one, two = errors
    assert two["mpjpe_g_mm"] < 40.0 and two["mpjpe_pa_mm"] < 25.0
    assert all(two[name] < 0.7 * one[name] for name in one)


class TestFiles:
    @pytest.fixture
    def films(self, kick: np.ndarray, tmp_path: Path) -> dict[str, Any]:
        """Files of two films, and of their cameras."""
        left, right = cameras_around(np.random.default_rng(6), kick, 2)
        paths = [
            written(tmp_path, "left_side", film_of(left, kick, 50.0, 0.0)),
            written(tmp_path, "right_side", film_of(right, kick, 50.0, 0.3, 1)),
        ]
        return {"paths": paths, "cameras": calibration(tmp_path, right=right, left=left), "folder": tmp_path,
                "right": right, "left": left}  # fmt: skip

    def test_cameras_are_found_by_name_and_what_was_found_is_said(self, films: dict[str, Any]) -> None:
        loaded = sources.load(films["paths"], camera_files=(films["cameras"],))
        assert "left_side.npz: camera left" in loaded.notes and "right_side.npz: camera right" in loaded.notes
        assert any(note.startswith("right_side.npz: person 0, began 0.") for note in loaded.notes)
        assert loaded.position_known and len(loaded.views.films) == 2
        np.testing.assert_allclose(loaded.views.as_images()[1][1].position, films["right"].position, atol=1e-9)
        np.testing.assert_array_equal(loaded.views.times, np.arange(len(loaded.views)) / 50.0)

    def test_cameras_can_be_named_or_are_taken_in_order(self, films: dict[str, Any]) -> None:
        file, folder = films["cameras"], films["folder"]
        named = sources.load(films["paths"], camera_files=[Path(f"{file}:{name}") for name in ("left", "right")])
        renamed = [path.rename(folder / f"{number}.npz") for number, path in enumerate(films["paths"])]
        in_order = sources.load(renamed[::-1], camera_files=(file,))
        np.testing.assert_array_equal(named.views.as_images()[1][0].position, in_order.views.as_images()[1][1].position)

    def test_a_film_that_ends_midway_is_said_to_show_less(self, films: dict[str, Any], kick: np.ndarray) -> None:
        short = film_of(films["right"], kick, 50.0, 0.3, 1)
        paths = [films["paths"][0], written(films["folder"], "right_side", short.cut(0, 39))]
        notes = sources.load(paths, camera_files=(films["cameras"],)).notes
        assert any("right_side.npz: shows the person in" in note and "% of the first film's" in note for note in notes)

    def test_how_near_the_cameras_see_the_same_points_is_said(self, films: dict[str, Any]) -> None:
        notes = sources.load(films["paths"], camera_files=(films["cameras"],)).notes
        distances = [float(note.split("within ")[1].split(" px")[0]) for note in notes if "cameras together" in note]
        assert len(distances) == 2 and all(0.5 < distance < 5.0 for distance in distances)

    def test_somebody_at_the_edge_of_another_film_does_not_end_the_search(self, films: dict[str, Any]) -> None:
        film, frames = arrays_of(films["folder"] / "right_side.npz"), []
        for places, confidence in zip(film["places"], film["confidence"], strict=True):
            whole = np.column_stack([np.nan_to_num(places), confidence])
            edge = np.where(np.arange(len(POINTS))[:, None] < 3, (40.0, 60.0, 0.9), 0.0)
            frames.append([person(whole), person(edge)])
        path = films["folder"] / "right_side.json"
        path.write_text(
            json.dumps([one | {"image_id": f"{row}.jpg"} for row, pair in enumerate(frames) for one in pair])
        )
        loaded = sources.load([films["paths"][0], path], (50.0,), SIZE, camera_files=(films["cameras"],))
        assert any(note.startswith("right_side.json: person 0") for note in loaded.notes)

    @pytest.mark.parametrize(
        ("unit", "turn", "message"),
        [
            (3.0, Rotation.identity(), r"has legs of 2\.\d m: their positions need metres"),
            (1.0, Rotation.from_euler("x", 90.0, degrees=True), r"stands along -y: their world needs z up"),
        ],
        ids=["another unit", "another axis up"],
    )
    def test_cameras_in_another_world_are_refused_by_whom_they_see(
        self, films: dict[str, Any], unit: float, turn: Rotation, message: str
    ) -> None:
        moved = {
            name: Camera(800.0, films[name].centre, films[name].turn @ turn.as_matrix().T,
                         unit * turn.apply(films[name].position) + (0.0, 0.0, 9.0))
            for name in ("left", "right")
        }  # fmt: skip
        with pytest.raises(InputError, match=f"^cameras: the person they see {message}$"):
            sources.load(films["paths"], camera_files=(calibration(films["folder"], **moved),))

    def test_exchanged_cameras_are_refused_by_how_far_points_are_off(self, films: dict[str, Any]) -> None:
        files = [Path(f"{films['cameras']}:{name}") for name in ("right", "left")]
        with pytest.raises(
            InputError, match=r"cameras: half of the points in .*npz are over \d+ px from where"
        ) as said:
            sources.load(films["paths"], camera_files=files)
        assert "\n" not in str(said.value)

    @pytest.mark.parametrize("rates", [(30.0, 60.0, 50.0), (2.0, 50.0)])
    def test_rates_that_are_not_the_films_are_refused(self, films: dict[str, Any], rates: tuple[float, ...]) -> None:
        with pytest.raises(InputError, match="rate"):
            sources.load(films["paths"], rates, camera_files=(films["cameras"],))

    def test_several_films_need_all_cameras(self, films: dict[str, Any]) -> None:
        with pytest.raises(
            InputError, match=r"cameras is empty, but 2 films need a calibration with each one's camera"
        ):
            sources.load(films["paths"])
        lens = films["folder"] / "lens.json"
        lens.write_text(json.dumps({"focal": 800.0}))
        with pytest.raises(InputError, match=r"cameras: that of right_side.npz has no position"):
            sources.load(films["paths"], camera_files=(Path(f"{films['cameras']}:left"), lens))
        with pytest.raises(InputError, match=r"cameras has 3 files, but needs one, or one for each of 2 films"):
            sources.load(films["paths"], camera_files=(lens, lens, lens))
        third = films["paths"][1].rename(films["folder"] / "other.npz")
        calibration(films["folder"], right=films["right"], left=films["left"], top=films["left"])
        with pytest.raises(InputError, match=r"calib.toml has 3 \(right, left, top\), but films are 2, whose names"):
            sources.load([films["paths"][0], third], camera_files=(films["cameras"],))

    def test_points_in_metres_are_no_pixels(self, films: dict[str, Any]) -> None:
        film = films["folder"] / "right_side.npz"
        content = dict(np.load(film))
        np.savez(film, **content | {"places": (content["places"] - 500.0) / 300.0})
        with pytest.raises(InputError, match=r"right_side.npz .*outside images"):
            sources.load(films["paths"], camera_files=(films["cameras"],))
