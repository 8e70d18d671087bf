"""Rollouts of many episodes, in chunks that one compiled program serves."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.learned.model import Model
from larp_model.networks import Weights
from larp_model.simulator import Simulator

# Rollouts are padded to multiples of so many steps: then one program serves all windows of a kick.
PADDED = 64


def predict(
    simulator: Simulator, states: np.ndarray, controls: np.ndarray, torques: np.ndarray, morphology: np.ndarray,
    chunk: int = 128,
) -> np.ndarray:  # fmt: skip
    """Return states (E, H, L, 13) that the simulator predicts from states (E, L, 13), chunk by chunk.

    What is compiled serves any H up to a multiple of `PADDED`.
    """
    parts, steps = [], controls.shape[1]
    padding = ((0, 0), (0, -steps % PADDED), (0, 0), (0, 0))
    controls, torques = np.pad(controls, padding), np.pad(torques, padding)
    for begin in range(0, len(states), chunk):
        rows = np.minimum(np.arange(begin, begin + chunk), len(states) - 1)
        inputs = (jnp.asarray(values[rows]) for values in (states, controls, torques, morphology))
        predicted = _roll(simulator.model, simulator.weights, *inputs, jnp.asarray(steps))
        parts.append(np.asarray(predicted)[:, :steps])
    return np.concatenate(parts)[: len(states)]


@partial(jax.jit, static_argnums=0)
def _roll(
    model: Model, weights: Weights, start: Array, targets: Array, torques: Array, sizes: Array, steps: Array
) -> Array:
    """Return the rollout, compiled once for all weights of a model."""
    return Simulator.of(model, weights).rollout(start, targets, torques=torques, morphology=sizes, steps=steps)
