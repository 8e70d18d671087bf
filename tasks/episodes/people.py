"""Random morphologies of humans, for training data."""

from __future__ import annotations

import numpy as np

from larp_model.bodies import detail_of, human, segment_of
from larp_model.scene import Scene

# Ranges of height [m], of mass [kg], and of mass / height^2 [kg/m^2].
HEIGHT, MASS, BUILD = (1.5, 2.0), (45.0, 110.0), (16.0, 38.0)
# Lengths and radii of single segments differ by up to this share.
VARIED = 0.15


def random_people(random: np.random.Generator, scene: Scene, count: int) -> np.ndarray:
    """Return morphologies (count, L, 3) of the scene, each with another human; left and right are alike."""
    sizes = np.broadcast_to(scene.morphology, (count, len(scene.links), 3)).astype(float)
    default_human = human(detail=detail_of(scene.body("human")))
    segments = [segment_of(link.name) for link in default_human.links]
    names, segment_rows = np.unique(segments, return_inverse=True)
    height = random.uniform(*HEIGHT, (count, 1))
    mass = random.uniform(*np.clip(np.multiply.outer(BUILD, height**2), *MASS))
    factors = random.uniform(1.0 - VARIED, 1.0 + VARIED, (count, len(names), 2))[:, segment_rows]
    length, radius, link_mass = default_human.sizes.T
    rows = scene.rows("human")
    sizes[:, rows, 0] = length * height / 1.75 * factors[..., 0]
    sizes[:, rows, 1] = radius * height / 1.75 * factors[..., 1]
    sizes[:, rows, 2] = link_mass * mass / 70.0
    return sizes
