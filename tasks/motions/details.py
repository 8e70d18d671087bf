"""Conversion of joint targets of the human of 13 links, the form of all motions, to those of more detailed humans."""

from __future__ import annotations

import numpy as np

from larp_model.anatomy import CHAINS
from larp_model.bodies import detail_of, human
from larp_model.scene import Body


def in_detail(body: Body, targets: np.ndarray) -> np.ndarray:
    """Return joint targets (*, J, 3) [rad] of a human, from those of the human of 13 links (*, 12, 3).

    Joints of a chain share a rotation equally; targets of joints that the human of 13 links lacks are zero.
    """
    if detail_of(body) == "lean":
        return targets
    default_human, detailed = human(), np.zeros((*targets.shape[:-2], len(body.motors), 3))
    rows = {body.links[child].name: row for row, (child, _, _) in enumerate(body.motors)}
    for row, (child, _, _) in enumerate(default_human.motors):
        name = default_human.links[child].name
        chain = CHAINS.get(name, (name,))
        for link in chain:
            detailed[..., rows[link], :] = targets[..., row, :] / len(chain)
    return detailed
