"""Task of coming to a stand after the kick; only the human is modelled, as no ball is in reach any more.

    minimise over theta   w_b mean_t s(t) |c(t) - m(t)|^2           the capture point comes to be between the feet
                        + w_f mean_t s(t) sum_i max(0, h_i(t))^2    both feet come down
                        + w_l mean_t sum_j |u_j(t)|^2               pelvis and torso stay upright
                        + w_u mean_t max(0, h - z_pelvis(t))^2      the pelvis stays up
                        + w_e mean_t |Q(t) - Q^stance(t)|^2         joint targets stay near those of a stance

c = x + v sqrt(z / g) of the centre of mass is the instantaneous capture point (J. Pratt et al., "Capture Point: A Step
toward Humanoid Push Recovery", 2006): where a foot would have to be to come to rest. m is the middle between the feet,
h_i a foot's height above the ground, u_j the horizontal part of a link's upward axis. s rises from 0 to 1 once the kick
has swung out; the targets change from the kick's to the stance's from the middle of the swing on. The planner chooses
where the human stands, and how wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.bodies import standing_height
from larp_model.scene import Scene
from mpc import CostTerm, Dynamics, Optimizer, Planner, Window, quadratic
from tasks import residuals
from tasks.exploration import exploration_std
from tasks.motions.references import Reference
from tasks.presets import usable

HORIZON = 50
KNOTS = 6
SEARCH = 0.5
# Steps from the strike until the kick has swung out, until it counts fully that the human stands, and until the joint
# targets are the stance's.
SWING_END, FULL_BALANCE, STANCE = 20, 50, 50
# Joint targets that are not zero when one stands: links and angles about x and y [rad], of the left side.
KNEES, ELBOWS = 0.5, 0.25


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StandingContext:
    """Data that the residuals need beside the states (H, n, 13) and controls (H, J, 3) of a candidate."""

    balance_share: Any  # (H,) by which balance and the height of the feet count
    pelvis_height: Any  # (H, 1) least height of the pelvis [m]
    controls: Any  # (H, J, 3) of the reference, then of the stance [rad]


class Standing:
    """Standing task of a scene's human (its first body) after a reference's strike: terms, windows and planner."""

    def __init__(self, scene: Scene, reference: Reference) -> None:
        self.scene, self.reference = scene, reference
        human = scene.human
        self.human = scene.rows(human.name)
        self.feet = np.array([human.link("left_foot"), human.link("right_foot")])
        self.trunk = np.array([human.link("pelvis"), human.link("torso")])
        self.lying = np.array([human.links[foot].radius for foot in self.feet], np.float32)
        self.height = standing_height(human)
        mass = np.array([link.mass for link in human.links], np.float32)
        self.share = mass / mass.sum()
        self.stance = stance(scene)

    def capture_point(self, states: Array) -> Array:
        """Return the capture point (*, 2) [m] of the human's states (*, n, 13), from the middle between its feet."""
        place = jnp.einsum("...lx,l->...x", packed.position(states), self.share)
        velocity = jnp.einsum("...lx,l->...x", packed.velocity(states), self.share)
        pace = jnp.sqrt(jnp.maximum(place[..., 2:], 0.1) / self.scene.gravity)
        return (place + pace * velocity)[..., :2] - jnp.mean(packed.position(states)[..., self.feet, :2], axis=-2)

    def balance(self, states: Array, controls: Array, context: StandingContext) -> Array:
        """Return `capture_point` (H, 2) [m], weighted by the context's `balance_share` (H,)."""
        weighted: Array = context.balance_share[:, None] * self.capture_point(states)
        return weighted

    def feet_above(self, states: Array, controls: Array, context: StandingContext) -> Array:
        """Return the heights of both feet above the ground (H, 2) [m], weighted by `balance_share` (H,)."""
        above = packed.position(states)[:, self.feet, 2] - self.lying
        weighted: Array = context.balance_share[:, None] * jnp.maximum(above, 0.0)
        return weighted

    def lean(self, states: Array, controls: Array, context: StandingContext) -> Array:
        """Return the horizontal parts of the upward axes of pelvis and torso (H, 4)."""
        up = rotation.matrix(packed.orientation(states[:, self.trunk]))[..., :2, 2]
        return up.reshape(len(states), -1)

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """Return the named cost terms of a candidate."""
        return (
            CostTerm("balance", self.balance, quadratic, 100.0),
            CostTerm("feet", self.feet_above, quadratic, 50.0),
            CostTerm("lean", self.lean, quadratic, 20.0),
            CostTerm("upright", residuals.upright, quadratic, 100.0),
            CostTerm("effort", residuals.effort, quadratic, 0.2),
        )

    def window(self, step: int) -> Window:
        """Return the joint targets from a step on and, as the residuals' context, how much standing counts."""
        ahead = step - self.reference.strike + np.arange(HORIZON)
        share = smooth((ahead - 0.5 * SWING_END) / (STANCE - 0.5 * SWING_END))[:, None, None]
        last = self.reference.window(self.reference.strike + SWING_END // 2, 1)[1]
        controls = (1.0 - share) * last + share * self.stance
        context = StandingContext(
            balance_share=np.clip((ahead - SWING_END) / (FULL_BALANCE - SWING_END), 0.0, 1.0),
            pelvis_height=np.full((HORIZON, 1), 0.95 * self.height),
            controls=controls,
        )
        return Window(step * self.scene.dt, controls, context)

    def planner(self, dynamics: Dynamics, optimizers: tuple[Optimizer, ...]) -> Planner:
        """Return a planner of this task on dynamics of the human alone."""
        return Planner(
            dynamics,
            self.terms,
            HORIZON,
            KNOTS,
            self.scene.dt,
            SEARCH * exploration_std(self.scene),
            usable(dynamics, optimizers),
            *self.scene.limits,
        )


def smooth(share: np.ndarray) -> np.ndarray:
    """Return a smooth step of `share`: from 0 to 1 without a corner, constant outside."""
    share = np.clip(share, 0.0, 1.0)
    return share**2 * (3.0 - 2.0 * share)


def stance(scene: Scene) -> np.ndarray:
    """Return joint targets (J, 3) [rad] of a human who stands with slightly bent knees, feet flat below the hips."""
    human = scene.human
    targets = np.zeros((len(human.motors), 3))
    for row, (child, _, _) in enumerate(human.motors):
        side, _, segment = human.links[child].name.partition("_")
        pitch = {"thigh": -0.5, "shin": 1.0, "foot": -0.5}.get(segment, 0.0) * KNEES
        roll = {"left": ELBOWS, "right": -ELBOWS}[side] if segment == "upper_arm" else 0.0
        targets[row] = roll, pitch, 0.0
    return targets
