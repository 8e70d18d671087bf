"""Single steps of the ground truth, as residual networks learn from them.

What the networks see and the errors of physics that they are to predict do not change while they learn, so that physics
is evaluated once for every step, before the training.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import losses
from larp_model.detection import contact_points
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Weights
from larp_model.state import Trajectories

# Errors of residual networks beyond this, in standard deviations, count linearly.
LARGE = 0.1
# Steps whose physics is evaluated at a time.
CHUNK = 1024


class StepExamples(NamedTuple):
    """B steps, with inputs (B, F) and errors of physics (B, O) of each network by name: see `ResidualModel.examples`.

    separate: (B,) 1 where no links of two bodies touch, else 0.
    """

    inputs: dict[str, Any]
    errors: dict[str, Any]
    separate: Any


def examples_of(
    model: ResidualModel, before: Array, after: Array, control: Array, torque: Array, morphology: Array
) -> StepExamples:
    """Return the examples of steps from states (B, L, 13) to states (B, L, 13).

    control: (B, J, 3) [rad]. torque: (B, L, 3) [N m]. morphology: (B, L, 3).
    """
    separate = jnp.ones(len(before))
    for _, points in contact_points(model.scene, before, morphology, after):
        separate *= 1.0 - jnp.max(points.near, axis=1)
    examples = model.examples(before, after, control, torque, morphology)
    return StepExamples(
        {name: inputs for name, inputs, _ in examples}, {name: errors for name, _, errors in examples}, separate
    )


def table_of(model: ResidualModel, sources: Sequence[Trajectories]) -> StepExamples:
    """Return the examples of all T steps of E episodes of all sources, (sum of E T, ...): 4 (F + O) bytes a step."""
    chunk_examples = jax.jit(partial(examples_of, model))
    totals = [int(np.prod(source.controls.shape[:2])) for source in sources]
    table: StepExamples | None = None
    end = 0
    for source, total in zip(sources, totals, strict=True):
        for begin in range(0, total, CHUNK):
            episodes, steps = np.divmod(np.arange(begin, begin + CHUNK).clip(max=total - 1), source.controls.shape[1])
            chunk = chunk_examples(
                source.states[episodes, steps], source.states[episodes, steps + 1], source.controls[episodes, steps],
                source.torques[episodes, steps], source.morphology[episodes],
            )  # fmt: skip
            if table is None:
                table = jax.tree.map(lambda part: np.empty((sum(totals), *part.shape[1:]), part.dtype), chunk)
            start, end = end, end + min(CHUNK, total - begin)
            for whole, part in zip(jax.tree.leaves(table), jax.tree.leaves(chunk), strict=True):
                whole[start:end] = part[: end - start]
    assert table is not None
    return table


def step_loss(model: ResidualModel, weights: Weights, examples: StepExamples) -> tuple[Array, dict[str, Array]]:
    """Return the loss of a model's networks on examples, and no other terms.

    Errors are in standard deviations of the outputs; beyond `LARGE` they count linearly. Steps in which links of two
    bodies touch are left out.
    """
    share = examples.separate / jnp.maximum(jnp.sum(examples.separate), 1.0)
    loss = jnp.zeros(())
    for name, inputs in examples.inputs.items():
        error = model.answer(weights, name, inputs) - weights.outputs[name].normalise(examples.errors[name])
        loss += jnp.sum(share * jnp.mean(losses.pseudo_huber(error**2, LARGE), axis=1))
    return loss, {}
