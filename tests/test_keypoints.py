"""Keypoints: the camera, the figure that is laid over them, what is told of a reconstruction, and its equations."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from larp_model.bodies import human_and_ball
from larp_model.engines.mujoco import closed
from larp_model.errors import InputError
from larp_model.scene import Scene
from tasks.motions.references import embedded
from tasks.pose import camera as cameras
from tasks.pose import figure as figures
from tasks.pose import lift, metrics, physical, synthetic_film
from tasks.pose.banded import Banded
from tasks.pose.figure import SHARED, Figure, Pose
from tasks.pose.points import POINTS, Keypoints
from tasks.pose.views import Views

SIZE = (1000.0, 800.0)
seeds = st.integers(0, 2**31)


def random_pose(random: np.random.Generator, figure: Figure, frames: int) -> Pose:
    share = random.uniform(0.0, 1.0, (frames, *figure.lower.shape))
    turn = Rotation.random(frames, rng=random).as_matrix()
    return Pose(random.standard_normal((frames, 3)), turn, figure.lower + share * (figure.upper - figure.lower))


@pytest.fixture(scope="module")
def kick() -> np.ndarray:
    """Points (T, P, 3) of the embedded kick, 50 frames a second, until after the strike."""
    reference, figure = embedded(human_and_ball()), figures.figure()
    points = physical.BodyPoints(figure.body, figure, np.zeros(SHARED))
    states = reference.states[: reference.strike + 40 : 2, : len(figure.body.links)]
    return np.asarray(points.points(states.astype(np.float32)), float)


def film_of(
    points: np.ndarray, seed: int, noise: synthetic_film.Noise = synthetic_film.USUAL_NOISE
) -> tuple[Keypoints, cameras.Camera]:
    random = np.random.default_rng(seed)
    lens = synthetic_film.camera_around(random, points)
    return synthetic_film.detected(random, lens, points, 50.0, noise), lens


def held_by_hand(film: Keypoints, lens: cameras.Camera) -> Views:
    """The film by a camera of which only the lens is known."""
    return Views((film,), (cameras.handheld(lens.focal, synthetic_film.SIZE),))


class TestCamera:
    @given(seeds)
    def test_what_lies_on_a_places_ray_is_projected_onto_the_place(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        lens = cameras.looking_at(random.uniform(-5, 5, 3) + np.array([0, 0, 6]), random.uniform(-1, 1, 3), 700.0, SIZE)
        places = random.uniform(0.0, 800.0, (7, 2))
        points = lens.position + random.uniform(0.5, 20.0, (7, 1)) * lens.ray(places)
        np.testing.assert_allclose(lens.project(points), places, atol=1e-6)

    def test_it_sees_what_it_looks_at_in_the_middle_and_what_is_above_it_higher(self) -> None:
        lens = cameras.looking_at(np.array([4.0, 1.0, 1.5]), np.array([0.0, 0.0, 1.0]), 900.0, SIZE)
        middle, above = lens.project(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.3]]))
        np.testing.assert_allclose(middle, (500.0, 400.0))
        assert abs(above[0] - 500.0) < 1e-6 and above[1] < 400.0

    def test_a_file_says_all_or_leaves_where_it_stands_open(self, tmp_path: Path) -> None:
        path = tmp_path / "camera.json"
        path.write_text(json.dumps({"size": [1000, 800], "field_of_view": 90.0}))
        lens, _, _, known = cameras.load(path)
        assert not known and lens.focal == pytest.approx(500.0)
        path.write_text(json.dumps({"focal": 800.0, "position": [4, 0, 2], "look_at": [0, 0, 1], "centre": [490, 410]}))
        lens, _, _, known = cameras.load(path, SIZE)
        assert known and lens.centre.tolist() == [490.0, 410.0] and lens.position.tolist() == [4.0, 0.0, 2.0]

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            ("[1]", "needs an object"),
            ("{", "is no JSON file"),
            ('{"size": [10, 10], "focus": 3}', "did you mean 'focal'"),
            ('{"focal": 500}', "has no size"),
            ('{"size": [10, 0]}', "needs numbers above 0"),
            ('{"size": [10, 10], "focal": 0}', "focal is 0, but must be above 0"),
            ('{"size": [10, 10], "focal": 5, "field_of_view": 60}', "has both"),
            ('{"size": [10, 10], "field_of_view": 170}', "must be from 10 to 150 degrees"),
            ('{"size": [10, 10], "position": [1, 2, 3]}', "needs both or neither"),
            ('{"size": [10, 10], "position": [1, 2, -3], "look_at": [0, 0, 0]}', "must be above the ground"),
            ('{"size": [10, 10], "position": [0, 0, 3], "look_at": [0, 0, 0]}', "which way is up"),
            ('{"size": [10, NaN]}', "needs 2 finite numbers"),
        ],
    )
    def test_what_it_cannot_be_is_refused_by_name(self, given: str, said: str, tmp_path: Path) -> None:
        path = tmp_path / "camera.json"
        path.write_text(given)
        with pytest.raises(InputError, match=r"camera|field_of_view|look_at") as refused:
            cameras.load(path)
        assert said in str(refused.value) and "\n" not in str(refused.value)


class TestFigure:
    @settings(max_examples=10)
    @given(seeds)
    def test_bones_are_as_long_in_every_pose(self, seed: int) -> None:
        figure, random = figures.figure(), np.random.default_rng(seed)
        proportions = 0.1 * random.standard_normal(SHARED)
        points = figure.all_points(random_pose(random, figure, 5), proportions)
        for one, other in (("hip", "knee"), ("knee", "ankle"), ("elbow", "wrist"), ("ankle", "toe")):
            for side in ("left", "right"):
                rows = [POINTS.index(f"{side}_{end}") for end in (one, other)]
                lengths = np.linalg.norm(np.diff(points[:, rows], axis=1), axis=-1)
                assert np.ptp(lengths) < 1e-5

    @settings(max_examples=10)
    @given(seeds)
    def test_who_is_larger_as_a_whole_is_larger_in_every_part(self, seed: int) -> None:
        figure, random = figures.figure(), np.random.default_rng(seed)
        pose = random_pose(random, figure, 3)
        larger = np.zeros(SHARED)
        larger[0] = np.log(1.2)
        small, large = (figure.all_points(pose, each) - pose.place[:, None] for each in (np.zeros(SHARED), larger))
        np.testing.assert_allclose(large, 1.2 * small, atol=1e-5)

    def test_its_height_is_that_of_the_human_it_is_of(self) -> None:
        figure, proportions = figures.figure(), np.zeros(SHARED)
        proportions[0] = np.log(1.6 / figures.USUAL_HEIGHT)
        assert figure.height(proportions) == pytest.approx(1.6)
        proportions[1 + figures.PROPORTIONS.index(("shin", 0))] = 0.1
        assert figure.height(proportions) > 1.62

    def test_its_points_are_where_the_simulated_human_has_them(self) -> None:
        figure, random = figures.figure(), np.random.default_rng(3)
        pose, proportions = random_pose(random, figure, 4), 0.05 * random.standard_normal(SHARED)
        body = figure.body_of(proportions)
        states = np.zeros((4, len(body.links), 13))
        states[:, :, 3:7] = body.pose(Rotation.from_matrix(pose.turn).as_quat(scalar_first=True), pose.angles)
        states[:, 0, :3] = pose.place
        seen = physical.BodyPoints(body, figure, proportions).points(closed(Scene((body,)), states).astype(np.float32))
        np.testing.assert_allclose(seen, figure.all_points(pose, proportions), atol=1e-5)


class TestMetrics:
    @given(seeds)
    def test_each_alignment_forgives_what_it_is_for(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        true = random.standard_normal((4, len(POINTS), 3))
        shifted = metrics.position_errors(true + random.standard_normal(3), true)
        wandering = metrics.position_errors(true + random.standard_normal((4, 1, 3)), true)
        turned = 1.3 * Rotation.random(rng=random).apply(true.reshape(-1, 3)).reshape(true.shape)
        assert max(shifted.values()) < 1e-6
        assert wandering["mpjpe_mm"] < 1e-6 < wandering["mpjpe_g_mm"]
        assert metrics.position_errors(turned, true)["mpjpe_pa_mm"] < 1e-6

    def test_a_steady_shift_is_no_error_of_velocity_and_jitter_is(self) -> None:
        true = np.random.default_rng(0).standard_normal((5, len(POINTS), 3))
        assert metrics.velocity_error(true + 1.0, true, 60.0) < 1e-9
        assert metrics.velocity_error(true + 0.01 * true[::-1], true, 60.0) > 0.1

    def test_feet_skate_where_they_slide_on_the_ground_alone(self) -> None:
        points = np.ones((20, len(POINTS), 3))
        points[:, metrics.FEET["left"], 2] = 0.01
        assert metrics.foot_skate(points) == 0.0
        points[:, :, 0] += 0.03 * np.arange(20)[:, None]
        assert metrics.foot_skate(points) == 100.0
        points[:, :, 2] += 0.2
        assert metrics.foot_skate(points) == 0.0

    def test_feet_that_take_turns_in_standing_do_not_slip_unless_all_is_carried_along(self) -> None:
        points, time = np.zeros((60, len(POINTS), 3)), np.arange(60) / 30.0
        left, right = (np.maximum(sign * np.sin(6.0 * time), 0.0) for sign in (1.0, -1.0))
        points[:, metrics.FEET["left"], 0], points[:, metrics.FEET["right"], 0] = left[:, None], right[:, None]
        assert metrics.slip(points, 30.0) < 0.01
        points[:, :, 1] += 0.4 * time[:, None]
        assert metrics.slip(points, 30.0) == pytest.approx(0.4, abs=0.1)

    def test_slip_is_the_same_in_films_that_are_shorter_than_a_stride(self) -> None:
        points = np.zeros((20, len(POINTS), 3))
        points[:, :, 0] = 0.4 * np.arange(20)[:, None] / 1000.0
        assert metrics.slip(points, 1000.0) == pytest.approx(0.4)

    def test_depth_in_the_ground_is_told(self) -> None:
        points = np.ones((4, len(POINTS), 3))
        points[0, metrics.FEET["left"], 2] = -0.04
        assert metrics.off_the_ground(points) == {"sunk_mm": pytest.approx(10.0), "sunk": 25.0}


class TestEquations:
    @given(seeds)
    def test_a_band_with_an_edge_is_solved_as_the_whole_matrix_is(self, seed: int) -> None:
        random, (frames, size, shared, rows) = np.random.default_rng(seed), (6, 4, 3, 5)
        band, whole, slope = Banded(frames, size, shared), np.zeros((27, 27)), np.zeros(27)
        for offsets in ((0,), (0, 1), (0, 1, 2)):
            length = frames - offsets[-1]
            weights, residual = random.uniform(0.5, 2.0, (length, rows)), random.standard_normal((length, rows))
            slopes = tuple((offset, random.standard_normal((length, rows, size + shared))) for offset in offsets)
            band.add(weights, residual, slopes)
            for frame in range(length):
                jacobian = np.zeros((rows, 27))
                for offset, each in slopes:
                    begin = size * (frame + offset)
                    jacobian[:, begin : begin + size] += each[frame, :, :size]
                    jacobian[:, -shared:] += each[frame, :, size:]
                whole += jacobian.T * weights[frame] @ jacobian
                slope += jacobian.T @ (weights[frame] * residual[frame])
        own, common = band.solve(0.1)
        expected = -np.linalg.solve(whole + 0.1 * np.diag(np.diag(whole)), slope)
        np.testing.assert_allclose(np.concatenate([own.ravel(), common]), expected, rtol=1e-3, atol=1e-5)
        gain = -2.0 * slope @ expected - expected @ whole @ expected
        assert band.gain(own, common, 0.1) == pytest.approx(gain, rel=1e-3)


class TestFilms:
    def test_without_noise_a_film_shows_where_points_are(self, kick: np.ndarray) -> None:
        film, lens = film_of(kick, 5, synthetic_film.Noise(0.0, 0.0, 0.0))
        np.testing.assert_allclose(film.places, lens.project(kick))
        assert film.detected.all() and (film.places > 0.0).all() and (film.places < synthetic_film.SIZE[0]).all()

    def test_what_is_missed_has_no_confidence(self, kick: np.ndarray) -> None:
        film, _ = film_of(kick, 5, synthetic_film.Noise(4.0, 0.3, 0.1))
        assert (np.isnan(film.places[..., 0]) == ~film.detected).all() and 0.1 < (~film.detected).mean() < 0.9

    def test_a_figure_laid_over_a_kick_is_near_the_true_one(self, kick: np.ndarray) -> None:
        film, lens = film_of(kick, 11)
        lifted = lift.lift(Views((film,), (lens,)))
        found = figures.figure().all_points(lifted.pose, lifted.proportions)
        errors = metrics.position_errors(found, kick)
        assert errors["mpjpe_g_mm"] < 120.0 and errors["mpjpe_pa_mm"] < 60.0
        assert lifted.error < 8.0 and metrics.foot_skate(found) <= 4.0

    def test_a_person_of_known_height_is_as_large_and_as_far_whatever_the_image(self, kick: np.ndarray) -> None:
        small = 1.6 / 1.75 * kick
        film, lens = film_of(small, 17)
        views = held_by_hand(film, lens)
        lifted = lift.lift(views, position_known=False, height=1.6)
        _, (camera,) = views.corrected(lifted.corrections).as_images()
        found = figures.figure().all_points(lifted.pose, lifted.proportions)
        far, true = (
            np.linalg.norm(metrics.pelvis(points)[:, 0] - np.asarray(by.position), axis=1).mean()
            for points, by in ((found, camera), (small, lens))
        )
        assert figures.figure().height(lifted.proportions) == pytest.approx(1.6, rel=0.01)
        assert far == pytest.approx(true, rel=0.04)

    def test_another_film_of_another_length_by_another_camera_compiles_nothing(
        self, kick: np.ndarray, caplog: pytest.LogCaptureFixture
    ) -> None:
        said = []
        for seed, frames in ((3, 12), (4, 55)):
            film, lens = film_of(kick, seed)
            caplog.clear()
            with jax.log_compiles():
                jax.jit(lambda x: x + 1.0)(1.0)
                lift.lift(Views((film.cut(0, frames - 1),), (lens,)))
            said.append(sum("Compiling" in each for each in caplog.messages))
        assert said[1] == 1 <= said[0], "it is only the function above that is compiled anew"

    def test_a_camera_of_which_only_the_lens_is_known_is_found_with_the_motion(self, kick: np.ndarray) -> None:
        film, lens = film_of(kick, 13)
        views = held_by_hand(film, lens)
        lifted = lift.lift(views, position_known=False)
        _, (camera,) = views.corrected(lifted.corrections).as_images()
        found = figures.figure().all_points(lifted.pose, lifted.proportions)
        errors = metrics.position_errors(found, kick)
        tilt, found_tilt = (float(np.arcsin(-np.asarray(each.turn)[2, 2])) for each in (lens, camera))
        assert errors["mpjpe_pa_mm"] < 50.0 and lifted.error < 8.0
        assert tilt > 0.3 and found_tilt == pytest.approx(tilt, abs=0.2), (
            "the person stands on the ground, not above it"
        )
        assert camera.position[2] == pytest.approx(lens.position[2], rel=0.35)
