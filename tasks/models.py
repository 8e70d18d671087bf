"""The planners' models of a scene of a human and a ball: which weights, and what of the scene each plan needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from larp_model import evaluation
from larp_model import weights as stored
from larp_model.bodies import detail_of, human_and_ball
from larp_model.names import require_known
from larp_model.networks import Weights
from larp_model.parts.part import Model
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.truth.mujoco import SUBSTEPS, Truth
from mpc import Continued, Dynamics, MujocoDynamics
from tasks.scenarios import ANY_HUMAN

# Steps that a plan looks beyond the reference's strike with the ball alone.
FLIGHT = 120
# Weights of the embedded kick of one body.
WEIGHTS = "human_ball"
# Candidates that MuJoCo rolls out side by side: few, for a small budget's sake.
ROWS = 8

DynamicsName = Literal["larp", "physics", "mujoco"]


class Models(NamedTuple):
    """The planners' models of the scene and of the human alone, and which weights they have."""

    whole: Dynamics
    human: Dynamics
    learned: bool
    weights: str

    def novelty(self, states: np.ndarray, controls: np.ndarray) -> float | None:
        """How far a trajectory is from what the model of the scene was trained on; None where nothing is learned.

        See `larp_model.evaluation.novelty`.
        """
        simulator = self.whole.dynamics if isinstance(self.whole, Continued) else self.whole
        if not (isinstance(simulator, Simulator) and simulator.weights.networks):
            return None
        return evaluation.novelty(simulator, states, controls)


def shipped(scene: Scene, embedded: bool) -> Path:
    """The manifest of the shipped weights for a kick: of the embedded one, or of any human in any motion."""
    known = embedded and scene == human_and_ball()
    return stored.SHIPPED / f"{WEIGHTS if known else ANY_HUMAN[detail_of(scene.bodies[0])]}.json"


def models_of(scene: Scene, name: DynamicsName, weights: Path, substeps: int = SUBSTEPS, rows: int = ROWS) -> Models:
    """The planners' models; that of the scene goes on with the ball alone once no link can reach it any more.

    larp: by these weights. physics: LARP's with nothing learned, of any human in any motion. mujoco: the truth itself.
    After the kick the human moves as it must: the shipped weights of the embedded kick leave it to those of any human.
    substeps: engine steps in a step of MuJoCo. rows: candidates that it rolls out side by side.
    """
    if name == "mujoco":
        return _continued(scene, [MujocoDynamics(Truth(part, rows, substeps)) for part in _parts(scene)], "none")
    require_known("dynamics", name, get_args(DynamicsName))
    if name == "physics":
        return _continued(scene, [Simulator.of_physics(part) for part in _parts(scene)], name)
    model, learned, manifest = stored.load(weights, scene)
    found = learned_models(scene, model, learned, manifest["sha256"][:12])
    if weights != stored.SHIPPED / f"{WEIGHTS}.json":
        return found
    any_human, motion, _ = stored.load(stored.SHIPPED / f"{ANY_HUMAN['lean']}.json", _parts(scene)[2])
    return found._replace(human=Simulator(any_human, motion))


def learned_models(scene: Scene, model: Model, weights: Weights, name: str) -> Models:
    """The planners' models by learned parts; see `models_of`. name: of the weights."""
    return _continued(scene, [Simulator(model.on(part), weights) for part in _parts(scene)], name)


def _parts(scene: Scene) -> tuple[Scene, Scene, Scene]:
    """Human and ball, the ball, and the human."""
    human, ball = scene.bodies[0].name, scene.bodies[-1].name
    return scene.only(human, ball), scene.only(ball), scene.only(human)


def _continued(scene: Scene, models: Sequence[Dynamics], weights: str) -> Models:
    whole, ball, human = models
    rest = slice(scene.rows(scene.bodies[0].name).stop, None)
    return Models(Continued(whole, ball, rest, FLIGHT), human, weights != "none", weights)
