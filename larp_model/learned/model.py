"""The interface of a model of a scene: its step in time, and the networks that the step needs."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol, Self

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from larp_model.networks import Measured, Perceptron, Weights
from larp_model.scene import Body, Scene


class Model(Protocol):
    """A model of a scene, frozen and static under jit: all that weights depend on is a field, so in the manifest."""

    @property
    def scene(self) -> Scene:
        """Return the scene."""

    @property
    def invariant(self) -> bool:
        """Return whether shifts along the ground and turns about z shift and turn what it returns.

        Else training augments its data.
        """

    @property
    def side_by_side(self) -> int:
        """Return the number of rollouts side by side at which one takes least time on a CPU."""

    def on(self, scene: Scene) -> Self:
        """Return the same model of a scene of bodies of the same kinds, or of some of them."""

    def networks(self) -> dict[str, Perceptron]:
        """Return the networks by name, see `network_name`; bodies of one kind share theirs."""

    def step(
        self, weights: Weights, state: Array, control: Array, torque: Array, morphology: Array, stop_gradient: bool
    ) -> Array:
        """Return states (B, L, 13) one `scene.dt` after states (B, L, 13).

        control (B, J, 3) joint targets [rad], torque (B, L, 3) [N m] from outside, world frame, morphology
        (B or 1, L, 3). stop_gradient: for training, take derivatives as if the networks' inputs were constant.
        """

    def measure(self, before: Array, after: Array, control: Array, torque: Array, morphology: Array) -> Measured:
        """Return statistics of the networks' inputs and outputs, from true steps (B, L, 13) -> (B, L, 13)."""


def network_name(kind: str, *bodies: Body) -> str:
    """Return the name of the network of bodies of these kinds: "dynamics/human", "contact/ball-human"."""
    if len(bodies) == 2 and bodies[0] == bodies[1]:
        return f"{kind}/{bodies[0].kind}-itself"
    return f"{kind}/{'-'.join(body.kind for body in bodies)}"


def initial_weights(model: Model, key: Array, statistics: Measured) -> Weights:
    """Return fresh networks; `statistics` as `Model.measure` gives them."""
    networks: dict[str, Any] = {}
    for index, (name, module) in enumerate(sorted(model.networks().items())):
        size = statistics[name][0].mean.shape[0]
        networks[name] = module.init(jax.random.fold_in(key, index), jnp.zeros((1, size)))
    inputs = {name: statistics[name][0].floored for name in networks}
    outputs = {name: changes.floored for name in networks if (changes := statistics[name][1]) is not None}
    return Weights(networks, inputs, outputs)


def untrained_weights(model: Model, key: Array) -> Weights:
    """Return fresh networks of a model, with statistics of its bodies at rest."""
    scene = model.scene
    state = (
        jnp.zeros((1, len(scene.links), packed.SIZE)).at[..., packed.ORIENTATION].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
    )
    control, torque = jnp.zeros((1, len(scene.motors), 3)), jnp.zeros((1, len(scene.links), 3))
    sizes = jnp.asarray(scene.morphology[None], jnp.float32)
    return initial_weights(model, key, model.measure(state, state, control, torque, sizes))


def blank_weights(model: Model) -> Weights:
    """Return the shapes and types of a model's weights."""
    blank = jax.eval_shape(partial(untrained_weights, model), jax.random.key(0))
    assert isinstance(blank, Weights)
    return blank
