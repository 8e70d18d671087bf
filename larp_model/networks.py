"""f_d and f_c: multi-layer perceptrons with ELU, and the configurations they come in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax
from jax import Array


@dataclass(frozen=True)
class Config:
    """What distinguishes one learned simulator from another.

    frame: the dynamics network sees the world's axes, or those of the body's heading. predict: it gives the next
    velocity, integrated semi-implicitly as in the paper, or the change of velocity and a correction of the trapezoidal
    step. contact: the contact network gives a free feature vector that the dynamics networks see, or an impulse along
    the contact's own directions, which balls take up directly and to which articulated bodies have a network of their
    own, of the contact network's size, that adds to the dynamics network's change. skip: residual connections. aided:
    the networks also see what they would else have to find out from rotations: the torques of the servos and how the
    ends of the links are to the ground. base: the dynamics network of an articulated body adds to nothing, or to what
    mechanics says of a body alone on the ground.
    """

    name: str
    layers: int
    width: int
    contact_layers: int
    contact_width: int
    ball_layers: int
    ball_width: int
    frame: Literal["world", "heading"]
    predict: Literal["velocity", "change"]
    contact: Literal["feature", "impulse"]
    skip: bool
    aided: bool
    base: Literal["nothing", "mechanics"] = "nothing"

    def __post_init__(self) -> None:
        for field in ("layers", "width", "contact_layers", "contact_width", "ball_layers", "ball_width"):
            value = getattr(self, field)
            if not (isinstance(value, int) and value >= 1):
                raise ValueError(f"config.{field} is {value!r}, but must be an integer of at least 1")
        for field, choices in (
            ("frame", ("world", "heading")),
            ("predict", ("velocity", "change")),
            ("contact", ("feature", "impulse")),
            ("base", ("nothing", "mechanics")),
        ):
            if getattr(self, field) not in choices:
                raise ValueError(f"config.{field} is {getattr(self, field)!r}, but must be one of {choices}")


PAPER = Config("paper", 12, 512, 6, 128, 12, 128, "world", "velocity", "feature", skip=False, aided=False)
COMPACT = Config("compact", 6, 256, 4, 128, 2, 32, "heading", "change", "impulse", skip=True, aided=True)
HYBRID = Config(
    "hybrid", 5, 128, 4, 128, 2, 32, "heading", "change", "impulse", skip=True, aided=True, base="mechanics"
)
CONFIGS = {config.name: config for config in (PAPER, COMPACT, HYBRID)}


class Perceptron(nn.Module):
    """`layers` dense layers of `width` with ELU between them, the last one giving `outputs` values."""

    layers: int
    width: int
    outputs: int
    skip: bool

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """(*, F) -> (*, outputs)."""
        hidden = inputs
        for index in range(self.layers - 1):
            new = jax.nn.elu(nn.Dense(self.width)(hidden))
            hidden = hidden + new if self.skip and index else new
        last = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        return nn.Dense(self.outputs, kernel_init=last)(hidden)
