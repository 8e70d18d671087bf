"""LARP: scenes of articulated bodies, and their learned, differentiable simulator."""

from larp_model.bodies import ball, capsule, chain, human, human_and_ball, standing_height
from larp_model.networks import COMPACT, PAPER, Config
from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface
from larp_model.simulator import Simulator, Weights

__all__ = [
    "COMPACT",
    "PAPER",
    "Body",
    "Config",
    "Joint",
    "Link",
    "Motor",
    "Pair",
    "Scene",
    "Simulator",
    "Surface",
    "Weights",
    "ball",
    "capsule",
    "chain",
    "human",
    "human_and_ball",
    "standing_height",
]
