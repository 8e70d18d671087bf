"""Stay up after the kick: only the human is modelled, for no ball is in reach any more.

    minimise over theta   w_c mean_t |c(t) - c^ref(t)|^2            the capture point stays where the reference has it
                        + w_r mean_t |x_i(t) - x_i^ref(t)|^2        links stay near the reference, root-aligned
                        + w_u mean_t max(0, h - z_pelvis(t))^2      the pelvis stays up
                        + w_e mean_t |Q(t) - Q^ref(t)|^2            joint targets stay near the reference's

c = x + v sqrt(z / g) of the centre of mass, seen from the standing foot, is the instantaneous capture point (J. Pratt
et al., "Capture Point: A Step toward Humanoid Push Recovery", 2006): where a foot would have to be to come to rest.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.bodies import standing_height
from larp_model.scene import Scene
from mpc import CostTerm, Dynamics, Optimizer, Planner, quadratic
from mpc.loop import Window
from tasks import residuals
from tasks.data import stray
from tasks.presets import usable
from tasks.references import Reference

HORIZON = 50
KNOTS = 6
SEARCH = 0.5


class Standing:
    """The standing task of a scene's human (its first body) along a reference: terms, windows and planner."""

    def __init__(self, scene: Scene, reference: Reference) -> None:
        self.scene, self.reference = scene, reference
        human = scene.bodies[0]
        self.human = scene.rows(human.name)
        self.foot = human.link("left_foot")
        self.height = standing_height(human)
        mass = np.array([link.mass for link in human.links], np.float32)
        self.share = mass / mass.sum()

    def capture_point(self, states: Array) -> Array:
        """The capture point (*, 2) [m] of the human's states (*, n, 13), from the standing foot's centre."""
        place = jnp.einsum("...lx,l->...x", packed.position(states), self.share)
        velocity = jnp.einsum("...lx,l->...x", packed.velocity(states), self.share)
        pace = jnp.sqrt(jnp.maximum(place[..., 2:], 0.1) / self.scene.gravity)
        return (place + pace * velocity)[..., :2] - packed.position(states)[..., self.foot, :2]

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """The named costs of a candidate."""

        def balance(states: Array, controls: Array, context: Any) -> Array:
            return self.capture_point(states) - context["capture_point"]

        return (
            CostTerm("balance", balance, quadratic, 100.0),
            CostTerm("reference", residuals.pose, quadratic, 20.0),
            CostTerm("upright", residuals.upright, quadratic, 100.0),
            CostTerm("effort", residuals.effort, quadratic, 0.2),
        )

    def window(self, step: int) -> Window:
        """The reference's window from a step on, as the residuals' context."""
        states, controls = self.reference.window(step, HORIZON)
        human = states[:, self.human]
        links = human[..., packed.POSITION]
        context = {
            "capture_point": np.asarray(self.capture_point(jnp.asarray(human))),
            "reference": links - links[:, :1],
            "counted": np.ones(HORIZON),
            "height": 0.98 * human[:, 0, 2:3],
            "controls": controls,
        }
        return Window(controls, context)

    def planner(self, dynamics: Dynamics, optimizers: tuple[Optimizer, ...]) -> Planner:
        """A planner of this task on dynamics of the human alone."""
        bounds = np.array([(motor.lower, motor.upper) for motor in self.scene.motors])
        return Planner(
            dynamics,
            self.terms,
            HORIZON,
            KNOTS,
            self.scene.dt,
            SEARCH * stray(self.scene),
            usable(dynamics, optimizers),
            bounds[:, 0],
            bounds[:, 1],
        )
