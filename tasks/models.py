"""Planners' models of a scene of a human and a ball, and of the human alone, with LARP or MuJoCo as dynamics."""

from __future__ import annotations

from collections.abc import Sequence
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
    """Planners' models of the scene and of the human alone.

    exact: whether they are MuJoCo itself, so that there is nothing to verify in it. weights: the beginning of their
    hash, or `NO_WEIGHTS`.
    """

    whole: Dynamics
    human: Dynamics
    exact: bool
    weights: str

    def novelty(self, states: np.ndarray, controls: np.ndarray) -> float | None:
        """Return how far a trajectory is from what the model was trained on; None where nothing is learned.

        See `larp_model.evaluation.novelty`.
        """
        simulator = self.whole.dynamics if isinstance(self.whole, Continued) else self.whole
        if not (isinstance(simulator, Simulator) and simulator.weights.networks):
            return None
        return evaluation.novelty(simulator, states, controls)


def models_of(
    scene: Scene, name: DynamicsName, weights: Path | None = None, substeps: int = SUBSTEPS, rows: int = ROWS
) -> Models:
    """Return the planners' models; that of the scene goes on with the ball alone once no link can reach it any more.

    name: larp, with these weights or with nothing learned, or mujoco, the ground truth itself. substeps: engine steps
    in a step of MuJoCo. rows: candidates that it rolls out side by side.
    """
    require_known("dynamics", name, get_args(DynamicsName))
    human, ball = scene.bodies[0].name, scene.bodies[-1].name
    parts = scene.only(human, ball), scene.only(ball), scene.only(human)
    if name == "mujoco":
        return _continued(scene, [MujocoDynamics(Truth(part, rows, substeps)) for part in parts], True, NO_WEIGHTS)
    if weights is None:
        return _continued(scene, [Simulator.of_physics(part) for part in parts], False, NO_WEIGHTS)
    model, learned, manifest = stored.load(weights, scene)
    simulators = [Simulator.of(model.on(part), learned) for part in parts]
    return _continued(scene, simulators, False, manifest["sha256"][:12])


def _continued(scene: Scene, models: Sequence[Dynamics], exact: bool, weights: str) -> Models:
    scene_model, ball_model, human_model = models
    rest = slice(scene.rows(scene.bodies[0].name).stop, None)
    return Models(Continued(scene_model, ball_model, rest, FLIGHT), human_model, exact, weights)
