"""Planners' models of a scene of a human and a ball, and of the human alone, with LARP or MuJoCo as dynamics."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from larp_model import evaluation
from larp_model import weights as stored
from larp_model.engines.mujoco import SUBSTEPS, Truth
from larp_model.names import require_known
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc import Continued, Dynamics, MujocoDynamics

# Steps that a plan looks beyond the reference's strike with the ball alone.
FLIGHT = 120
# Candidates that MuJoCo rolls out side by side: few, to suit a small budget.
ROWS = 8
# Name of the weights in a summary where nothing is learned.
NO_WEIGHTS = "none"

DynamicsName = Literal["larp", "mujoco"]


class Models(NamedTuple):
    """Planners' models of a scene and of its human alone.

    scene: goes on with the ball alone once no link can reach it any more; see `with_flight`. simulator: of the scene
    without that, where LARP is the model. exact: whether they are MuJoCo itself, which needs no validation in it.
    weights: the beginning of their hash, or `NO_WEIGHTS`.
    """

    scene: Dynamics
    human: Dynamics
    simulator: Simulator | None
    exact: bool
    weights: str

    def novelty(self, states: np.ndarray, controls: np.ndarray) -> float | None:
        """Return how far a trajectory is from what the model was trained on; None where nothing is learned.

        See `larp_model.evaluation.novelty`.
        """
        if self.simulator is None or not self.simulator.weights.networks:
            return None
        return evaluation.novelty(self.simulator, states, controls)


def models_of(
    scene: Scene, name: DynamicsName, weights: Path | None = None, substeps: int = SUBSTEPS, rows: int = ROWS
) -> Models:
    """Return the planners' models.

    name: larp, with these weights or with nothing learned, or mujoco, the ground truth itself. substeps: engine steps
    in a step of MuJoCo. rows: candidates that it rolls out side by side.
    """
    require_known("dynamics", name, get_args(DynamicsName))
    human, ball = scene.human.name, scene.ball.name
    parts = scene.only(human, ball), scene.only(ball), scene.only(human)
    if name == "mujoco":
        engines = [MujocoDynamics(Truth(part, rows, substeps)) for part in parts]
        return Models(with_flight(scene, engines[0], engines[1]), engines[2], None, True, NO_WEIGHTS)
    label = NO_WEIGHTS
    if weights is None:
        simulators = [Simulator.of_physics(part) for part in parts]
    else:
        model, learned, manifest = stored.load(weights, scene)
        simulators, label = [Simulator.of(model.on(part), learned) for part in parts], manifest["sha256"][:12]
    return Models(with_flight(scene, simulators[0], simulators[1]), simulators[2], simulators[0], False, label)


def with_flight(scene: Scene, scene_model: Dynamics, ball_model: Dynamics) -> Dynamics:
    """Return dynamics of a scene that follow the ball alone for `FLIGHT` more steps."""
    return Continued(scene_model, ball_model, slice(scene.rows(scene.human.name).stop, None), FLIGHT)
