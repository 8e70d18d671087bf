"""LARP: one step is contact -> dynamics -> integrate; a rollout repeats it.

M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024), with the
choices of `networks.Config`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact, features, mechanics, rotation
from larp_model import state as packed
from larp_model.features import Statistics
from larp_model.networks import Config, Perceptron
from larp_model.scene import Body, Pair, Scene

# Solid spheres: moment of inertia / (mass x radius^2).
SPHERE = 0.4
# Impulse [N s] from which a body's response is heard in full.
FELT = 0.2
# Bounds of what the networks may add, so that no state, however odd, is thrown out of the world.
# Contact: share of the free impact, normal speed [m/s], slide, binormal, upward speed [m/s], lag [ms].
CONTACT_BOUNDS = (1.0, 3.0, 1.0, 1.0, 3.0, 5.0)
# Ball on the ground: share of the free bounce, speed [m/s], stick, drag, grip, roll, twist, lag [ms].
BALL_BOUNDS = (1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5, 3.0)
# Articulated bodies: changes, in their standard deviations.
CHANGE_BOUND = 20.0


class Weights(NamedTuple):
    """Everything that is learned or measured: network parameters and statistics, by kind of body or pair.

    networks: {"dynamics/human": flax parameters, "contact/human-ball": ...}. inputs: Statistics by the same names.
    outputs: those of the dynamics networks whose outputs are changes of state.
    """

    networks: dict[str, Any]
    inputs: dict[str, Statistics]
    outputs: dict[str, Statistics]


def dynamics_name(body: Body) -> str:
    """Name of the network of a body's kind."""
    return f"dynamics/{body.kind}"


def contact_name(scene: Scene, pair: Pair) -> str:
    """Name of the network of a pair's kinds."""
    return f"contact/{scene.body(pair.first).kind}-{scene.body(pair.second).kind}"


def by_scalars(config: Config, body: Body) -> bool:
    """Whether a body is a ball whose network sees invariant scalars instead of a frame."""
    return config.frame == "heading" and body.is_ball


def dynamics_network(config: Config, body: Body) -> Perceptron:
    """f_d for a body's kind."""
    if by_scalars(config, body):
        return Perceptron(config.ball_layers, config.ball_width, len(BALL_BOUNDS), config.skip)
    outputs = changes_of(config, body)
    layers, width = (config.ball_layers, config.ball_width) if body.is_ball else (config.layers, config.width)
    return Perceptron(layers, width, outputs, config.skip)


def changes_of(config: Config, body: Body) -> int:
    """How many numbers say how a body moves on."""
    return len(body.links) * (6 if config.predict == "velocity" else 12)


def responds(scene: Scene, config: Config, body: Body) -> bool:
    """Whether a body has a network for what impulses do to it."""
    touched = any(body.name in (pair.first, pair.second) for pair in scene.pairs)
    return touched and config.contact == "impulse" and not by_scalars(config, body)


def response_name(body: Body) -> str:
    """Name of the network of what impulses do to a body's kind."""
    return f"response/{body.kind}"


def response_network(config: Config, body: Body) -> Perceptron:
    """Of what impulses do to a body's kind."""
    return Perceptron(config.contact_layers, config.contact_width, changes_of(config, body), config.skip)


def evaluate(network: Perceptron, weights: Weights, name: str, inputs: Array) -> Array:
    """Outputs (*, O) of a network for its inputs (*, F), normalised first."""
    outputs = network.apply(weights.networks[name], weights.inputs[name].normalise(inputs))
    assert isinstance(outputs, jax.Array)
    return outputs


def contact_network(config: Config) -> Perceptron:
    """f_c."""
    outputs = len(CONTACT_BOUNDS) if config.contact == "impulse" else 6
    return Perceptron(config.contact_layers, config.contact_width, outputs, config.skip)


def bounded(outputs: Array, bounds: tuple[float, ...] | float) -> Array:
    """Outputs (*, O) within +-bounds, smoothly, and unchanged near zero."""
    limit = jnp.asarray(bounds, outputs.dtype)
    return limit * jnp.tanh(outputs / limit)


class Pooled(NamedTuple):
    """What all contacts do to each link in a step: feature or impulse and moment (B, L, 6), and the share of the step
    times impulse that acts on the position, (B, L, 3) [N s^2]."""

    feature: Array
    travel: Array


def untouched(state: Array) -> Pooled:
    """What contacts do to the links of states (B, L, 13) where there are none."""
    return Pooled(jnp.zeros((*state.shape[:2], 6), state.dtype), jnp.zeros((*state.shape[:2], 3), state.dtype))


def contacts(scene: Scene, config: Config, weights: Weights, state: Array, free: Array, morphology: Array) -> Pooled:
    """Sum f_c over the contacts of every link (equation 1 of the paper).

    state (B, L, 13); free (B, L, 13), what it would become if nothing touched.
    """
    links = len(scene.links)
    feature, travel = untouched(state)
    for pair in scene.pairs:
        name = contact_name(scene, pair)
        first, second = features.pair_rows(scene, pair)
        to_first, to_second = (jax.nn.one_hot(rows, links, dtype=state.dtype) for rows in (first, second))
        network = partial(evaluate, contact_network(config), weights, name)
        if config.contact == "feature":
            inputs = features.paper_contact_inputs(scene, pair, state, morphology)
            for seen, rows in zip(inputs, (to_first, to_second), strict=True):
                feature += jnp.einsum("bpf,pl->blf", network(seen), rows)
            continue
        touch = features.contact_inputs(scene, pair, state, free, morphology)
        outputs = bounded(network(touch.inputs), CONTACT_BOUNDS) * touch.near[..., None]
        impulse, lag = contact_impulse(touch, outputs)
        on_first = jnp.concatenate([-impulse, jnp.cross(touch.first_arm, -impulse)], axis=-1)
        on_second = jnp.concatenate([impulse, jnp.cross(touch.second_arm, impulse)], axis=-1)
        feature += jnp.einsum("bpf,pl->blf", on_first, to_first) + jnp.einsum("bpf,pl->blf", on_second, to_second)
        moved = impulse * lag
        travel += jnp.einsum("bpf,pl->blf", moved, to_second) - jnp.einsum("bpf,pl->blf", moved, to_first)
    return Pooled(feature, travel)


def contact_impulse(touch: features.Touch, outputs: Array) -> tuple[Array, Array]:
    """Impulse (B, P, 3) [N s] on the second link and its lag (B, P, 1) [s], from the network's gated outputs (B, P, 6).

    Along the normal: the free impact's, which the network scales and adds to; across it: along the slide, the binormal
    and, for the ground's reaction, up.
    """
    scale, add, along, across, up, late = jnp.split(outputs, len(CONTACT_BOUNDS), axis=-1)
    change = touch.impact.change[..., None]
    normal = change * (1.0 + scale) + add
    vertical = jnp.array([0.0, 0.0, 1.0], outputs.dtype)
    velocity = (
        normal * touch.normal + along * touch.slide + across * jnp.cross(touch.normal, touch.slide) + up * vertical
    )
    lag = touch.impact.lag[..., None] + 0.001 * late
    return touch.mass[..., None, None][..., 0] * velocity, lag


def step(
    scene: Scene,
    config: Config,
    weights: Weights,
    state: Array,
    control: Array,
    torque: Array | None = None,
    morphology: Array | None = None,
    stop_gradient: bool = False,
) -> Array:
    """Advance states (B, L, 13) by `scene.dt` under joint targets (B, J, 3) [rad].

    torque: external, (B, L, 3) [N m], world frame. morphology (B or 1, L, 3); the scene's by default.
    stop_gradient: hold the contact's inputs fixed, as in the paper's training; never when planning.
    """
    torque = jnp.zeros((*state.shape[:-1], 3), state.dtype) if torque is None else torque
    morphology = features.morphology_of(scene)[None] if morphology is None else morphology
    seen = jax.lax.stop_gradient(state) if stop_gradient else state
    bodies = list(articulated(scene, config, state, control, torque, morphology))
    free, changed = seen, []
    if config.contact == "impulse":
        changed = [dynamics(config, weights, each, each.inputs) for each in bodies]
        # What the motors do meanwhile is no small part of an impact.
        free = moved(scene, config, state, bodies, changed)
        free = jax.lax.stop_gradient(free) if stop_gradient else free

        def meet() -> tuple[Pooled, list[Array]]:
            pooled = contacts(scene, config, weights, seen, free, morphology)
            return pooled, [
                change + response(config, weights, each, pooled.feature[:, each.rows])
                if responds(scene, config, each.body)
                else change
                for each, change in zip(bodies, changed, strict=True)
            ]

        # Steps without contact are by far the most.
        near = [features.within_reach(scene, pair, seen, free, morphology) for pair in scene.pairs]
        apart = untouched(state), changed
        pooled, changed = jax.lax.cond(jnp.stack(near).any(), meet, lambda: apart) if near else apart
    else:
        pooled = contacts(scene, config, weights, seen, free, morphology)
        for each in bodies:
            own = pooled.feature[:, each.rows]
            changed.append(dynamics(config, weights, each, features.with_pooled(each.inputs, each.turn, own)))
    after = moved(scene, config, state, bodies, changed)
    for body in scene.bodies:
        rows = scene.rows(body.name)
        if by_scalars(config, body):
            own_pooled = Pooled(pooled.feature[:, rows], pooled.travel[:, rows])
            ball = ball_step(
                scene, config, weights, body, state[:, rows], own_pooled, torque[:, rows], morphology[:, rows]
            )
            after = after.at[:, rows].set(ball)
    return after


class Seen(NamedTuple):
    """A body with a dynamics network: its rows in the state, its frame (B, 2) and inputs (B, F).

    base (B, 2 or 4, n, 3): what is known of its changes without learning; see `integrate`.
    """

    body: Body
    rows: slice
    turn: Array
    inputs: Array
    base: Array


def articulated(
    scene: Scene, config: Config, state: Array, control: Array, torque: Array, morphology: Array
) -> Iterator[Seen]:
    """All bodies that have a dynamics network, in states (B, L, 13)."""
    apart, joint = features.displacement(scene, state, morphology), 0
    for body in scene.bodies:
        rows, motors = scene.rows(body.name), scene.motor_rows(body.name)
        joints = slice(joint, joint + len(body.joints))
        joint += len(body.joints)
        if not by_scalars(config, body):
            own, targets, turn = state[:, rows], control[:, motors], frame(config, body, state[:, rows])
            base = jnp.zeros((1, 1, 1, 3), state.dtype)
            if config.base == "mechanics":
                free = mechanics.free_motion(
                    body, own, targets, torque[:, rows], morphology[:, rows], scene.gravity, scene.dt
                )
                base = known_changes(own, free, scene.dt)
                soon = packed.pack(packed.position(own), packed.orientation(own), free.velocity, free.spin)
                inputs = features.inputs_after(body, turn, own, soon, apart[:, joints], morphology[:, rows], scene.dt)
            else:
                inputs = features.body_inputs(
                    body,
                    turn,
                    own,
                    targets,
                    torque[:, rows],
                    apart[:, joints],
                    morphology[:, rows],
                    config.aided,
                    scene.dt,
                )
            yield Seen(body, rows, turn, inputs, base)


def known_changes(state: Array, free: mechanics.Motion, dt: float) -> Array:
    """The changes (B, 4, n, 3) with which `integrate` makes of states (B, n, 13) what mechanics says."""
    velocity, spin = packed.velocity(state), packed.angular_velocity(state)
    corrections = free.moved - 0.5 * dt * (velocity + free.velocity), free.turned - 0.5 * dt * (spin + free.spin)
    return jnp.stack([free.velocity - velocity, free.spin - spin, *corrections], axis=1)


def dynamics(config: Config, weights: Weights, seen: Seen, inputs: Array) -> Array:
    """The outputs (B, 2 or 4, n, 3) of a body's dynamics network, world frame; see `integrate`."""
    name = dynamics_name(seen.body)
    outputs = evaluate(dynamics_network(config, seen.body), weights, name, inputs)
    return seen.base + to_world(weights.outputs[name].restore(bounded(outputs, CHANGE_BOUND)), seen)


def response(config: Config, weights: Weights, seen: Seen, pooled: Array) -> Array:
    """What the pooled impulses (B, n, 6) add to `dynamics`; exactly nothing where there are none."""
    inputs = features.with_pooled(seen.inputs, seen.turn, pooled)
    outputs = evaluate(response_network(config, seen.body), weights, response_name(seen.body), inputs)
    felt = jnp.tanh(contact.norm(pooled[..., :3]).sum(axis=-1, keepdims=True) / FELT)
    return to_world(weights.outputs[dynamics_name(seen.body)].spread * bounded(outputs, CHANGE_BOUND) * felt, seen)


def to_world(outputs: Array, seen: Seen) -> Array:
    """A network's outputs (B, O) as vectors (B, 2 or 4, n, 3) in the world frame."""
    size = outputs.shape[0]
    turned = rotation.about_z(outputs.reshape(size, -1, 3), seen.turn[:, None])
    return turned.reshape(size, -1, len(seen.body.links), 3)


def moved(scene: Scene, config: Config, state: Array, bodies: list[Seen], changed: list[Array]) -> Array:
    """The states (B, L, 13) after the changes of these bodies; all others stay as they are."""
    for each, change in zip(bodies, changed, strict=True):
        state = state.at[:, each.rows].set(integrate(config, state[:, each.rows], change, scene.dt))
    return state


def frame(config: Config, body: Body, state: Array) -> Array:
    """Cosine and sine (B, 2) of the frame in which a body (B, n, 13) is seen."""
    if config.base == "mechanics":
        return rotation.course(packed.orientation(state)[:, 0], body.links[0].axis)
    if config.frame == "heading":
        return rotation.heading(packed.orientation(state)[:, 0])
    return jnp.broadcast_to(jnp.array([1.0, 0.0], state.dtype), (state.shape[0], 2))


def integrate(config: Config, state: Array, outputs: Array, dt: float) -> Array:
    """The next states (B, n, 13) from the dynamics network's outputs (B, 2 or 4, n, 3), world frame.

    `velocity`: velocity and angular velocity, x' = x + v' dt, as in the paper. `change`: their changes, and
    corrections [m, rad] of x' = x + (v + v') dt / 2, which an impact within the step needs.
    """
    if config.predict == "velocity":
        velocity, spin = outputs[:, 0], outputs[:, 1]
        moved, turned = velocity * dt, spin * dt
    else:
        velocity = packed.velocity(state) + outputs[:, 0]
        spin = packed.angular_velocity(state) + outputs[:, 1]
        moved = 0.5 * dt * (packed.velocity(state) + velocity) + outputs[:, 2]
        turned = 0.5 * dt * (packed.angular_velocity(state) + spin) + outputs[:, 3]
    return packed.pack(
        packed.position(state) + moved, rotation.integrate(packed.orientation(state), turned), velocity, spin
    )


def changes(config: Config, state: Array, after: Array, dt: float) -> Array:
    """The outputs (B, 2 or 4, n, 3) with which `integrate` would give `after`: what the output statistics measure."""
    velocity, spin = packed.velocity(after), packed.angular_velocity(after)
    if config.predict == "velocity":
        return jnp.stack([velocity, spin], axis=1)
    moved = packed.position(after) - packed.position(state)
    relative = rotation.multiply(packed.orientation(after), rotation.conjugate(packed.orientation(state)))
    turned = rotation.to_rotation_vector(relative)
    before, spinning = packed.velocity(state), packed.angular_velocity(state)
    return jnp.stack(
        [
            velocity - before,
            spin - spinning,
            moved - 0.5 * dt * (before + velocity),
            turned - 0.5 * dt * (spinning + spin),
        ],
        axis=1,
    )


def ball_step(
    scene: Scene, config: Config, weights: Weights, body: Body, state: Array, pooled: Pooled, torque: Array,
    morphology: Array,
) -> Array:  # fmt: skip
    """One step of a ball (B, 1, 13): free flight, contacts' impulses, torque (B, 1, 3), a learned bounce and slide.

    Away from every contact it is exact free flight.
    """
    name, dt = dynamics_name(body), scene.dt
    ball, impulse, morphology = state[:, 0], pooled.feature[:, 0], morphology[:, 0]
    radius, mass = morphology[:, 1:2], morphology[:, 2:3]
    ground = features.ball_inputs(body, ball, impulse, morphology, scene.gravity, dt)
    outputs = evaluate(dynamics_network(config, body), weights, name, ground.inputs)
    outputs = bounded(outputs, BALL_BOUNDS) * ground.near[:, None]
    scale, add, stick, drag, grip, roll, twist, late = jnp.split(outputs, len(BALL_BOUNDS), axis=-1)
    up = jnp.array([0.0, 0.0, 1.0], state.dtype)
    velocity, spin = packed.velocity(ball), packed.angular_velocity(ball)
    along = velocity * (1.0 - up)
    kick = impulse[:, :3] / mass
    bounce = ground.bounce.change[:, None] * (1.0 + scale) + add
    lag = ground.bounce.lag[:, None] + 0.001 * late
    slide = -stick * ground.slip - drag * along
    new_velocity = velocity - scene.gravity * dt * up + kick + bounce * up + slide
    moment = (impulse[:, 3:] + dt * torque[:, 0]) / (SPHERE * mass * radius**2)
    rolling = (grip * jnp.cross(up, ground.slip) + roll * jnp.cross(up, along)) / (SPHERE * radius)
    new_spin = spin + moment + rolling - twist * spin * up
    moved = (
        velocity * dt
        - 0.5 * scene.gravity * dt**2 * up
        + pooled.travel[:, 0] / mass
        + bounce * lag * up
        + 0.5 * dt * slide
    )
    turned = 0.5 * dt * (spin + new_spin)
    return packed.pack(
        packed.position(ball) + moved, rotation.integrate(packed.orientation(ball), turned), new_velocity, new_spin
    )[:, None]


@dataclass(frozen=True, eq=False)
class Simulator:
    """A scene with learned weights: pure, jit-able, batched, differentiable."""

    scene: Scene
    config: Config
    weights: Weights

    differentiable = True

    def step(self, state: Array, control: Array, torque: Array | None = None, morphology: Array | None = None) -> Array:
        """States (N, L, 13) after one `scene.dt` under controls (N, J, 3) [rad]; see `rollout` for the rest."""
        given = self._checked(state, control, torque, morphology, ())
        return step(self.scene, self.config, self.weights, *given)

    def rollout(
        self, state: Array, controls: Array, steps: Array | None = None, torques: Array | None = None,
        morphology: Array | None = None,
    ) -> Array:  # fmt: skip
        """States (N, H, L, 13) after each of H steps from states (N, L, 13) under controls (N, H, J, 3) [rad].

        From where a trajectory diverges it holds NaN: see `state.healthy`.

        steps (): so many of the H are computed, the rest repeat the last; all by default. torques: external, (N, H, L,
        3) [N m]. morphology (N or 1, L, 3); the scene's by default. All are taken in the state's precision, 32
        or 64 bits. Positions in 32 bits are 0.1 mm apart 1 km from the origin: plan near it.
        """
        given = self._checked(state, controls, torques, morphology, np.shape(controls)[1:2])
        states = rollout(self.scene, self.config, self.weights, *given, steps=steps)
        lost = jnp.cumsum(~packed.healthy(states), axis=1) > 0
        return jnp.where(lost[..., None, None], jnp.nan, states)

    def _checked(
        self, state: Array, control: Array, torque: Array | None, morphology: Array | None, steps: tuple[int, ...]
    ) -> tuple[Array, Array, Array | None, Array | None]:
        """The public arguments as JAX arrays, refused by name where they do not fit; steps: (H,) or none."""
        state, links, motors = jnp.asarray(state), len(self.scene.links), len(self.scene.motors)
        if state.ndim != 3 or state.shape[1:] != (links, packed.SIZE):
            raise ValueError(f"state has shape {state.shape}, but needs (N, {links}, {packed.SIZE})")
        if state.dtype not in (jnp.float32, jnp.float64):
            raise ValueError(f"state has numbers of type {state.dtype}, but needs float32 or float64")
        needed = {
            "controls": (control, (len(state), *steps, motors, 3)),
            "torques": (torque, (len(state), *steps, links, 3)),
        }
        for name, (value, size) in needed.items():
            if value is not None and np.shape(value) != size:
                wanted = f"({len(state)}, {'H, ' if steps else ''}{size[-2]}, 3)"
                raise ValueError(f"{name} have shape {np.shape(value)}, but need {wanted}")
        if morphology is not None and np.shape(morphology) not in ((1, links, 3), (len(state), links, 3)):
            raise ValueError(f"morphology has shape {np.shape(morphology)}, but needs ({len(state)} or 1, {links}, 3)")
        torque, morphology = (
            None if value is None else jnp.asarray(value, state.dtype) for value in (torque, morphology)
        )
        return state, jnp.asarray(control, state.dtype), torque, morphology


def rollout(
    scene: Scene, config: Config, weights: Weights, state: Array, controls: Array, torques: Array | None = None,
    morphology: Array | None = None, stop_gradient: bool = False, steps: Array | None = None,
) -> Array:  # fmt: skip
    """States (B, H, L, 13) after each of H steps; the arguments are those of `step`, with a time axis second.

    steps (): so many of the H are computed, the rest repeat the last; all by default.
    """

    def advance(current: Array, inputs: tuple[Array, Array | None]) -> Array:
        control, torque = inputs
        return step(scene, config, weights, current, control, torque, morphology, stop_gradient)

    def next_state(current: Array, inputs: tuple[Array, tuple[Array, Array | None]]) -> tuple[Array, Array]:
        number, given = inputs
        if steps is None:
            after = advance(current, given)
        else:
            after = jax.lax.cond(number < steps, advance, lambda held, _: held, current, given)
        return after, after

    by_time = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (controls, torques))
    _, states = jax.lax.scan(next_state, state, (jnp.arange(controls.shape[1]), by_time))
    return jnp.moveaxis(states, 0, 1)


Measured = dict[str, tuple[Statistics, Statistics | None]]


def initial_weights(scene: Scene, config: Config, key: Array, statistics: Measured) -> Weights:
    """Fresh networks for the scene; `statistics` holds (inputs, outputs) by network name."""
    networks: dict[str, Any] = {}
    modules = {dynamics_name(body): dynamics_network(config, body) for body in scene.bodies}
    modules |= {contact_name(scene, pair): contact_network(config) for pair in scene.pairs}
    modules |= {
        response_name(body): response_network(config, body) for body in scene.bodies if responds(scene, config, body)
    }
    for index, (name, module) in enumerate(sorted(modules.items())):
        size = statistics[name][0].mean.shape[0]
        networks[name] = module.init(jax.random.fold_in(key, index), jnp.zeros((1, size)))
    inputs = {name: statistics[name][0] for name in networks}
    outputs = {name: found for name in networks if (found := statistics[name][1]) is not None}
    return Weights(networks, inputs, outputs)


def measure(
    scene: Scene, config: Config, before: Array, after: Array, control: Array, torque: Array,
    morphology: Array | None = None,
) -> Measured:  # fmt: skip
    """Statistics of inputs and outputs by network, from true steps (B, L, 13) -> (B, L, 13).

    morphology (B or 1, L, 3); the scene's by default. Statistics of contacts are taken where there is one, for
    elsewhere their networks are not heard; the true step stands for the one without contact.
    """
    morphology = features.morphology_of(scene)[None] if morphology is None else morphology
    rarely = 1e-3
    free = after
    found: Measured = {}
    for body in scene.bodies:
        rows = scene.rows(body.name)
        if by_scalars(config, body):
            ball, none = before[:, rows][:, 0], jnp.zeros((len(before), 6))
            ground = features.ball_inputs(body, ball, none, morphology[:, rows][:, 0], scene.gravity, scene.dt)
            found[dynamics_name(body)] = Statistics.of(ground.inputs, ground.near + rarely), None
            free = free.at[:, rows].set(before[:, rows])
    for seen in articulated(scene, config, before, control, torque, morphology):
        body, rows = seen.body, seen.rows
        outputs = changes(config, before[:, rows], after[:, rows], scene.dt) - seen.base
        outputs = outputs.reshape(len(before), -1, 3)
        outputs = rotation.about_z(outputs, rotation.opposite(seen.turn)[:, None]).reshape(len(before), -1)
        alone = Statistics.of(seen.inputs)
        touched = features.with_pooled_statistics(alone, body)
        inputs = touched if config.contact == "feature" else alone
        found[dynamics_name(body)] = inputs, Statistics.of(outputs)
        if responds(scene, config, body):
            found[response_name(body)] = touched, None
    for pair in scene.pairs:
        touch = features.contact_inputs(scene, pair, before, free, morphology)
        near = touch.near.reshape(-1) + rarely
        if config.contact == "feature":
            sights = jnp.concatenate(features.paper_contact_inputs(scene, pair, before, morphology), axis=1)
            near = jnp.tile(touch.near, (1, 2)).reshape(-1) + rarely
        else:
            sights = touch.inputs
        found[contact_name(scene, pair)] = Statistics.of(sights.reshape(-1, sights.shape[-1]), near), None
    return found
