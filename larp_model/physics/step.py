"""A step of a whole scene by physics alone: each body on its own, then the contacts of links that touch.

Where links touch within a step, the scene's step is taken in two halves, each with its contacts (`impact`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import rotated
from larp_model.physics.ball import ball_motion, flight
from larp_model.physics.collision import Candidates, ContactSettings, Rates
from larp_model.physics.impact import integrate
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.physics.motion import Articulation, BodyMotion, Constants, articulated_motion, velocity_products
from larp_model.scene import Body, Scene

# Number of scenes with contacts that are stepped at a time on a CPU: more do not fit into the caches of a core. A GPU
# takes all at once, which is 13 times faster at 512 of them.
CHUNK = 32


class StepInputs(NamedTuple):
    """States (L, 13, B) before a step, targets (J, 3, B) [rad], torques (L, 3, B) [N m], and sizes (L, 3, B)."""

    state: Array
    targets: Array
    torques: Array
    sizes: Array


BallMotion = Callable[[Body, Kinematics, Array, float, float], BodyMotion]
"""(body, kinematics, torques (1, 3, B), gravity, dt [s]) -> motion (1, 3, B) each."""

Correction = Callable[[Body, Kinematics, BodyMotion, float], BodyMotion]
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
    candidates = Candidates(scene)

    def free_motion(
        inputs: StepInputs, links: Kinematics, dt: float, of_balls: BallMotion
    ) -> tuple[BodyMotion, dict[str, Articulation]]:
        motions, articulations = [], {}
        for body in scene.bodies:
            body_links, torques = links.of(scene, body.name), inputs.torques[scene.rows(body.name)]
            if body.is_ball:
                motion = of_balls(body, body_links, torques, scene.gravity, dt)
            else:
                targets = inputs.targets[scene.motor_rows(body.name)]
                motion, articulations[body.name] = articulated_motion(
                    body, body_links, targets, torques, scene.gravity, dt, constants
                )
            motions.append(correct(body, body_links, motion, dt))
        return BodyMotion(*(jnp.concatenate(array) for array in zip(*motions, strict=True))), articulations

    def half(inputs: StepInputs, _: None) -> tuple[StepInputs, None]:
        dt, links = 0.5 * scene.dt, kinematics(scene, inputs.state, inputs.sizes)
        # Balls are integrated with all that touches them, the ground as well.
        motion, articulations = free_motion(inputs, links, dt, flight)
        rates = _rates(scene, links, motion, articulations, dt)
        contact_motion = integrate(
            scene, links, rates, articulations, candidates.gaps(links, rates, dt, settings), dt, settings
        )
        total = BodyMotion(*(own + more for own, more in zip(motion, contact_motion, strict=True)))
        return inputs._replace(state=_after(links, total)), None

    links = kinematics(scene, start.state, start.sizes)
    motion, articulations = free_motion(start, links, scene.dt, ball_motion)
    after = _after(links, motion)
    if scene.pairs:
        rates = _rates(scene, links, motion, articulations, scene.dt)
        gaps = candidates.gaps(links, rates, scene.dt, settings)
        near = jnp.min(gaps, axis=0) < settings.margin
        after = _where(near, lambda inputs: jax.lax.scan(half, inputs, length=2)[0].state, start, after)
    return jnp.moveaxis(after, -1, 0)


def _where(near: Array, contact_step: Callable[[StepInputs], Array], start: StepInputs, otherwise: Array) -> Array:
    """Return states (L, 13, B) by `contact_step` where near (B,), chunk by chunk, and the other states elsewhere."""
    count = near.shape[0]
    # The count may be a symbol: see `jax.export`.
    size = min(CHUNK, count) if isinstance(count, int) and jax.default_backend() == "cpu" else count
    if size == count:
        refined = jax.lax.cond(jnp.any(near), contact_step, lambda inputs: inputs.state, start)
        return jnp.where(near, refined, otherwise)
    order = jnp.argsort(~near)
    rows = order[np.minimum(np.arange(count + -count % size), count - 1)].reshape(-1, size)

    def chunk(_: None, rows: Array) -> tuple[None, Array]:
        chunk_inputs: StepInputs = jax.tree.map(lambda array: array[..., rows], start)
        return None, jax.lax.cond(jnp.any(near[rows]), contact_step, lambda inputs: inputs.state, chunk_inputs)

    _, chunks = jax.lax.scan(chunk, None, rows)
    refined = jnp.moveaxis(chunks, 0, -2).reshape(*otherwise.shape[:2], -1)[..., jnp.argsort(order)]
    return jnp.where(near, refined, otherwise)


def _rates(
    scene: Scene, links: Kinematics, motion: BodyMotion, articulations: dict[str, Articulation], dt: float
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
