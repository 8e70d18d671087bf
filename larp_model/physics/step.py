"""A step of a whole scene by physics alone: each body on its own, then the contacts of links that touch.

Where links touch within a step, the scene's step is taken in two halves, each with its contacts (`impact`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import rotated, saved
from larp_model.physics.ball import ball_motion
from larp_model.physics.collision import Candidates, ContactSettings, Rates
from larp_model.physics.impact import integrate
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.physics.motion import Articulation, BodyMotion, Constants, articulated_motion, velocity_products
from larp_model.scene import Body, Scene

# Number of scenes with contacts that are stepped at a time on a CPU: more do not fit into the caches of a core. A GPU
# takes all at once.
CHUNK = 128
# What reverse mode saves of a step: see `linalg.saved`.
SAVED = jax.checkpoint_policies.save_only_these_names("saved")


class StepInputs(NamedTuple):
    """States (L, 13, B) before a step, targets (J, 3, B) [rad], torques (L, 3, B) [N m], and sizes (L, 3, B)."""

    state: Array
    targets: Array
    torques: Array
    sizes: Array


Correction = Callable[[Body, Kinematics, BodyMotion, Array | float], BodyMotion]
"""(body, kinematics, motion (n, 3, B) each, dt [s]) -> motion that a network has corrected."""


def step(
    scene: Scene, state: Array, control: Array, torque: Array, morphology: Array,
    constants: Constants, settings: ContactSettings,
    correct: Correction = lambda body, links, motion, dt: motion,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) one `scene.dt` after states (B, L, 13).

    control (B, J, 3) [rad], torque (B, L, 3) [N m], morphology (B or 1, L, 3). correct: see `Correction`.
    """
    before, targets, torques, sizes = (jnp.moveaxis(array, 0, -1) for array in (state, control, torque, morphology))
    start = StepInputs(before, targets, torques, jnp.broadcast_to(sizes, (*sizes.shape[:2], state.shape[0])))
    return jnp.moveaxis(SceneStep(scene, constants, settings, correct).run(start), -1, 0)


@dataclass(frozen=True)
class SceneStep:
    """A step of a scene: whole where no links touch each other, else in two halves, each with its contacts.

    Reverse-mode derivatives save the states before each part and the solutions of its equations, and compute the rest
    again: what a rollout saves does not grow with the number of operations in a step.
    """

    scene: Scene
    constants: Constants
    settings: ContactSettings
    correct: Correction

    def run(self, start: StepInputs) -> Array:
        """Return states (L, 13, B) after the step, of `CHUNK` scenes at a time on a CPU.

        No scene of a chunk takes contacts where none has any: so scenes are sorted by their gaps.
        """
        count = start.state.shape[-1]
        # The count may be a symbol: see `jax.export`.
        of_one_chunk = not isinstance(count, int) or count <= CHUNK
        if of_one_chunk or not self.scene.pairs or jax.default_backend() != "cpu":
            return self.chunk(start)
        order = jnp.argsort(self.rough_gaps(jax.lax.stop_gradient(start)))
        chunks = order[np.minimum(np.arange(count + -count % CHUNK), count - 1)].reshape(-1, CHUNK)

        def chunk(_: None, numbers: Array) -> tuple[None, Array]:
            return None, self.chunk(jax.tree.map(lambda array: array[..., numbers], start))

        _, after = jax.lax.scan(chunk, None, chunks)
        return jnp.moveaxis(after, 0, -2).reshape(*start.state.shape[:2], -1)[..., jnp.argsort(order)]

    def rough_gaps(self, start: StepInputs) -> Array:
        """Return the smallest gaps (B,) [m] between links within a step at constant velocities."""
        scene, settings = self.scene, replace(self.settings, moments=2)
        links = kinematics(scene, start.state, start.sizes)
        constant = Rates(*[jnp.zeros_like(links.velocity)] * len(Rates._fields))
        return jnp.min(Candidates(scene).gaps(links, constant, scene.dt, settings), axis=0)

    def chunk(self, start: StepInputs) -> Array:
        """Return states (L, 13, B) after a step."""
        if not self.scene.pairs:
            return self.part(start, start.state, self.scene.dt, True)[0]

        def next_part(carry: tuple[Array, Array, Array], whole: Array) -> tuple[tuple[Array, Array, Array], None]:
            state, after, near = carry
            dt = jnp.where(whole, self.scene.dt, 0.5 * self.scene.dt)
            moved, touching = jax.lax.cond(
                whole | jnp.any(near),
                lambda state: self.part(start, state, dt, whole),
                lambda state: (state, near),
                state,
            )
            states = jnp.where(whole, state, moved), jnp.where(whole, moved, after)
            return (*states, jnp.where(whole, touching, near)), None

        nowhere = jnp.zeros(start.state.shape[-1], bool)
        # One program for the whole step and the two halves: it is compiled once.
        (halves, whole, near), _ = jax.lax.scan(
            next_part, (start.state, start.state, nowhere), jnp.array([True, False, False])
        )
        return jnp.where(near, halves, whole)

    def part(self, start: StepInputs, state: Array, dt: Array | float, whole: Array | bool) -> tuple[Array, Array]:
        """Return states (L, 13, B) `dt` [s] after others, without contacts of links where the step is whole.

        And where (B,) links touch meanwhile.
        """

        @partial(jax.checkpoint, prevent_cse=False, policy=SAVED)
        def advanced(state: Array) -> tuple[Array, Array]:
            if not self.scene.pairs:
                links = kinematics(self.scene, state, start.sizes)
                return _after(links, self.free_motion(start, links, dt, whole)[0]), jnp.zeros(state.shape[-1], bool)
            motion, links, rates, articulations, gaps = self.before_contacts(start, state, dt, whole)
            added = self.contact_motion(links, rates, articulations, gaps, dt, whole)
            total = BodyMotion(*(own + more for own, more in zip(motion, added, strict=True)))
            return _after(links, total), jnp.min(gaps, axis=0) < self.settings.margin

        after: tuple[Array, Array] = advanced(state)
        return after

    def before_contacts(
        self, start: StepInputs, state: Array, dt: Array | float, whole: Array | bool
    ) -> tuple[BodyMotion, Kinematics, Rates, dict[str, Articulation], Array]:
        """Return all that contacts within `dt` [s] depend on: see `impact.integrate`; and the motion without them."""
        links = kinematics(self.scene, state, start.sizes)
        motion, articulations = self.free_motion(start, links, dt, whole)
        rates = _rates(self.scene, links, motion, articulations, dt)
        fixed_links, fixed_rates = jax.lax.stop_gradient((links, rates))
        gaps = Candidates(self.scene).gaps(fixed_links, fixed_rates, dt, self.settings)
        return motion, links, rates, articulations, gaps

    def free_motion(
        self, start: StepInputs, links: Kinematics, dt: Array | float, whole: Array | bool
    ) -> tuple[BodyMotion, dict[str, Articulation]]:
        """Return the motion of all links, each body on its own, and the inertia of articulated bodies by name.

        In halves balls are integrated with all that touches them, the ground as well: see `impact`.
        """
        scene, motions, articulations = self.scene, [], {}
        for body in scene.bodies:
            body_links, torques = links.of(scene, body.name), start.torques[scene.rows(body.name)]
            if body.is_ball:
                motion = ball_motion(body, body_links, torques, scene.gravity, dt, whole)
            else:
                targets = start.targets[scene.motor_rows(body.name)]
                motion, articulations[body.name] = articulated_motion(
                    body, body_links, targets, torques, scene.gravity, dt, self.constants
                )
            motions.append(self.correct(body, body_links, motion, dt))
        return BodyMotion(*(jnp.concatenate(array) for array in zip(*motions, strict=True))), articulations

    def contact_motion(
        self, links: Kinematics, rates: Rates, articulations: dict[str, Articulation], gaps: Array,
        dt: Array | float, whole: Array | bool,
    ) -> BodyMotion:  # fmt: skip
        """Return the motion that contacts add, none in a whole step; see `impact.integrate`."""

        @partial(jax.checkpoint, prevent_cse=False, policy=SAVED)
        def contacts(
            links: Kinematics, rates: Rates, articulations: dict[str, Articulation], gaps: Array
        ) -> BodyMotion:
            return integrate(self.scene, links, rates, articulations, gaps, dt, self.settings)

        def none(links: Kinematics, *_: object) -> BodyMotion:
            return BodyMotion(*[jnp.zeros_like(links.velocity)] * len(BodyMotion._fields))

        motion: BodyMotion = saved(jax.lax.cond(whole, none, contacts, links, rates, articulations, gaps))
        return motion


def _rates(
    scene: Scene, links: Kinematics, motion: BodyMotion, articulations: dict[str, Articulation], dt: Array | float
) -> Rates:
    """Return the accelerations of all links of a scene, from the motion of its bodies within `dt` [s]."""
    rates = []
    for body in scene.bodies:
        rows = scene.rows(body.name)
        zero = jnp.zeros_like(links.velocity[rows])
        jerks = products = zero, zero
        if articulation := articulations.get(body.name):
            jerks = articulation.jerk, articulation.angular_jerk
            if body.joints:
                products = velocity_products(body, articulation.anchors, links.angular_velocity[rows])
        rates.append((*jerks, *products))
    return Rates(
        (motion.velocity - links.velocity) / dt, (motion.angular_velocity - links.angular_velocity) / dt,
        *(jnp.concatenate(columns) for columns in zip(*rates, strict=True)),
    )  # fmt: skip


def _after(links: Kinematics, motion: BodyMotion) -> Array:
    """Return states (L, 13, B) after a motion."""
    return jnp.concatenate(
        [
            links.position + motion.translation,
            rotated(links.orientation, motion.rotation_vector),
            motion.velocity,
            motion.angular_velocity,
        ],
        axis=1,
    )
