"""Models of a scene by name, and the sizes of their networks.

residual  physics of bodies and contacts, whose motion of articulated bodies a network corrects
paper     the networks and sizes of the paper
"""

from __future__ import annotations

from typing import Literal, get_args

from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.learned.paper import PaperModel
from larp_model.learned.residual import ResidualModel
from larp_model.names import require_known
from larp_model.networks import Size
from larp_model.scene import Scene

DesignName = Literal["residual", "paper"]
SizeName = Literal["tiny", "small", "base"]
# Of residual networks.
SIZES: dict[SizeName, Size] = {"tiny": Size(3, 64), "small": Size(4, 128), "base": Size(4, 256)}


def design(scene: Scene, name: DesignName = "residual", size: SizeName | None = None) -> Model:
    """Return the untrained model of a scene; size: of residual networks, small by default."""
    require_known("design", name, get_args(DesignName))
    if name == "residual":
        require_known("size", size or "small", SIZES)
        return ResidualModel(scene, SIZES[size or "small"])
    if size:
        raise InputError(f"size is {size!r}, but only the residual design comes in sizes, not {name!r}")
    return PaperModel(scene)
