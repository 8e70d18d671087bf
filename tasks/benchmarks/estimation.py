"""Errors of estimates when the ball is touched, beside those of the sensors and the least that estimators can make."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from rich.table import Table

from larp_model import state as packed
from larp_model.linearization import Coordinates
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc.estimator import LEAST_VARIANCE, Estimate, Observation
from tasks.sensing import Perception, TwoPhaseFilter, moved_uniformly
from tasks.sensors import rotations

# Steps of a kick for which the model's derivatives are computed, always as many: another number is compiled again.
STEPS = 60


EstimateErrors = dict[str, dict[str, float]]
"""Errors by quantity and kind: see `estimate_errors`."""


class Quantities(NamedTuple):
    """Linear functions (3 m, n) of the coordinates of a state, whose errors are reported."""

    ball_position: np.ndarray  # m, from the human's root
    ball_velocity: np.ndarray  # m/s
    joint_angles: np.ndarray  # rad

    @classmethod
    def of(cls, scene: Scene) -> Quantities:
        """Return those of a scene with one human and one ball."""
        parts = Coordinates(scene).by_body()
        (human,), (ball,) = ([own for body, own in parts if body.is_ball == is_ball] for is_ball in (False, True))
        half = parts[-1][1].stop
        unit = np.eye(2 * half)
        place, root, velocity = (unit[begin : begin + 3] for begin in (ball.start, human.start, half + ball.start))
        return cls(place - root, velocity, unit[human.start + 6 : human.stop])


def estimate_errors(
    scene: Scene, perception: Perception, states: np.ndarray, controls: np.ndarray, step: int
) -> EstimateErrors:
    """Return the errors in a step of an execution, usually the last before the ball is touched.

    states (T + 1, L, 13), controls (T, J, 3): the true ones. By quantity, root mean squares of each component: `raw`,
    of the last sample, nan where there is none; `estimate`; and `bound`, the Cramer-Rao bound, nan where the
    estimator is no filter. `normalised`: the squared error by its covariance, 1 on average where that is honest.
    """
    simulator, quantities = Simulator.of_physics(scene), Quantities.of(scene)
    estimate = perception.estimates[step]
    deviation = np.asarray(simulator.difference(*_single(states[step], estimate.state)), float)
    least = least_covariance(perception, simulator, states, controls, step)
    raw = sample_errors(scene, simulator, perception, states, step)
    figures = {}
    for name, rows in quantities._asdict().items():
        error = rows @ deviation
        known = rows @ estimate.covariance[: len(deviation), : len(deviation)] @ rows.T
        known += LEAST_VARIANCE * np.eye(len(rows))  # the last sample of what rests has no error
        figures[name] = {
            "raw": _size(raw[name]),
            "estimate": _size(error),
            "bound": math.sqrt(np.trace(rows @ least @ rows.T) / len(rows)),
            "normalised": float(error @ np.linalg.solve(known, error)) / len(rows),
        }
    return figures


def least_covariance(
    perception: Perception, simulator: Simulator, states: np.ndarray, controls: np.ndarray, step: int
) -> np.ndarray:
    """Return the least covariance (n, n) that an unbiased estimate of the state can have in a step; nan for no filter.

    With the derivatives A of the model along the true states, and the process noise Q of the filter,

        P' = A P A^T + Q,    P <- (P^-1 + H^T R^-1 H)^-1    for each sample that arrived by then

    (P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering", 1998.)
    """
    estimator, start, dt = perception.timeline.estimator, perception.start, perception.dt
    count = len(start.covariance) - len(start.bias)
    if not isinstance(estimator, TwoPhaseFilter) or step > STEPS:
        return np.full((count, count), math.nan)
    before = round(-start.time / dt)
    rows = np.minimum(np.arange(STEPS), len(controls) - 1)
    derivatives = np.asarray(simulator.linearize(states[rows], controls[rows])[0], float)
    in_uniform_motion = np.eye(count)
    in_uniform_motion[: count // 2, count // 2 :] = dt * np.eye(count // 2)
    samples: list[list[Observation]] = [[] for _ in range(before + step + 1)]
    for arrived in perception.samples[: before + step + 1]:
        for sample in arrived:
            samples[round((sample.time - start.time) / dt)].append(sample.observation)
    covariance = start.covariance
    for row, observations in enumerate(samples):
        number = row - before
        part = estimator.before if number <= 0 else estimator.after
        if row:
            transition = np.eye(len(covariance))
            transition[:count, :count] = in_uniform_motion if number <= 0 else derivatives[number - 1]
            covariance = transition @ covariance @ transition.T
            covariance[:count, :count] += np.diag(part.process_noise)
        truth = states[number] if number >= 0 else moved_uniformly(simulator, states[0], number * dt)
        for observation in observations:
            covariance = part.corrected(Estimate(0.0, truth, covariance, start.bias), observation).covariance
    return covariance[:count, :count]


def sample_errors(
    scene: Scene, simulator: Simulator, perception: Perception, states: np.ndarray, step: int
) -> dict[str, np.ndarray]:
    """Return the errors (3 m,) of the last samples until a step, by quantity; nan where nothing was measured.

    A velocity that is not measured is the difference of the last two places, over the time between them.
    """
    quantities, unknown = Quantities.of(scene), np.full(3, math.nan)
    (ball,) = (scene.rows(body.name).start for body in scene.bodies if body.is_ball)
    places, joints, velocity = list[tuple[float, np.ndarray]](), unknown, unknown
    for arrived in perception.samples[: len(perception.samples) - len(perception.estimates) + step + 1]:
        for time, observation in arrived:
            number = round(time / perception.dt)
            if number < 0:
                continue
            truth = states[number]
            deviation = np.asarray(simulator.difference(*_single(observation.state, truth)), float)
            deviation[~np.isfinite(observation.variance)] = math.nan
            place = _errors(quantities.ball_position, deviation)
            if observation.origin is not None:
                arm = truth[ball, packed.POSITION] - truth[observation.origin, packed.POSITION]
                place = rotations(truth[observation.origin]).apply(observation.places[ball]) - arm
            if np.isfinite(place).all():
                places.append((time, place))
            if np.isfinite(own := _errors(quantities.joint_angles, deviation)).all():
                joints, velocity = own, _errors(quantities.ball_velocity, deviation)
    if not np.isfinite(velocity).all() and len(places) > 1:
        velocity = (places[-1][1] - places[-2][1]) / (places[-1][0] - places[-2][0])
    return {"ball_position": places[-1][1] if places else unknown, "ball_velocity": velocity, "joint_angles": joints}


def mean_errors(kicks: list[EstimateErrors]) -> EstimateErrors:
    """Return the root mean squares of the errors of several kicks, and the means of normalised ones."""
    if not kicks:
        return {}

    def mean(name: str, kind: str) -> float:
        values = np.array([errors[name][kind] for errors in kicks])
        values = values[np.isfinite(values)]
        if not len(values):
            return math.nan
        return float(values.mean() if kind == "normalised" else np.sqrt(np.mean(np.square(values))))

    return {name: {kind: mean(name, kind) for kind in errors} for name, errors in kicks[0].items()}


def errors_table(errors: dict[str, EstimateErrors]) -> Table:
    """Return a table of errors by what they are of: root mean squares of each component, before the ball is touched.

    normalised: squared errors by their covariance, 1 where the estimator knows how much it knows.
    """
    columns = ("planner, sensors and delay", "error of", "last sample", "estimate", "bound", "normalised")
    table = Table(*columns, title="What was known of the state")
    units = {"ball_position": (1e3, "mm"), "ball_velocity": (1e3, "mm/s"), "joint_angles": (1e3, "mrad")}
    for point, by_name in errors.items():
        for name, values in by_name.items():
            scale, unit = units[name]
            sizes = (values[kind] for kind in ("raw", "estimate", "bound"))
            texts = (f"{scale * size:.1f} {unit}" if math.isfinite(size) else "-" for size in sizes)
            table.add_row(point, name.replace("_", " "), *texts, f"{values['normalised']:.2f}")
    return table


def _errors(rows: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return linear functions (M, n) of a deviation (n,); nan where they take a part that is nan."""
    known = np.isfinite(deviation)
    errors: np.ndarray = rows @ np.where(known, deviation, 0.0)
    return np.where((rows[:, ~known] != 0.0).any(axis=1), math.nan, errors)


def _single(*states: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(state, np.float32) for state in states)


def _size(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
