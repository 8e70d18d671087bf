"""LARP: scenes of articulated bodies, and their learned, differentiable simulator."""

from larp_model.bodies import ball, capsule, chain, human, human_and_ball, standing_height
from larp_model.designs import design
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.networks import Weights
from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface
from larp_model.simulator import Simulator

__version__ = "0.1.0"

__all__ = [
    "Body",
    "InputError",
    "Joint",
    "Link",
    "Model",
    "Motor",
    "Pair",
    "Scene",
    "Simulator",
    "Surface",
    "Weights",
    "ball",
    "capsule",
    "chain",
    "design",
    "human",
    "human_and_ball",
    "standing_height",
]
