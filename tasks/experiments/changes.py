"""Designs of models, and changes of one part of them or of their training, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from larp_model.learned.model import Model
from larp_model.learned.paper import PaperModel, Sizes, Variant
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size
from larp_model.scene import Scene
from larp_model.training import Recipe
from tasks.train import ALGORITHM_1, OVER_PHYSICS

# A quarter of the paper's widths and half of its layers: what two cores can train many times.
SMALL = Sizes(Size(6, 128, skip=False), Size(6, 64, skip=False), Size(4, 64, skip=False))
# Unroll in steps, share of the updates: the paper's longest at last, of few lengths, since each is compiled.
UNROLLS = ((2, 0.2), (6, 0.2), (12, 0.2), (20, 0.4))
OF_NETWORKS = replace(ALGORITHM_1, curriculum=UNROLLS, learning_rate=1e-3)


class Design(NamedTuple):
    """Model of a scene, and the recipe by which it is trained."""

    model: Callable[[Scene], Model]
    recipe: Recipe


class Change(NamedTuple):
    """Change of a design, in its model or in its recipe."""

    model: Callable[[Model], Model] = lambda model: model
    recipe: Callable[[Recipe], Recipe] = lambda recipe: recipe


def _paper(scene: Scene) -> Model:
    return PaperModel(scene, SMALL)


def _supertrack(scene: Scene) -> Model:
    """Return L. Fussell, K. Bergamin, D. Holden's world model (2021), of the same size.

    It sees the state in the root's frame, knows no displacements, and gives accelerations; no body touches another.
    """
    variant = Variant(contact="none", left_out=("displacement",), root_frame=True, outputs="change")
    return PaperModel(scene, SMALL, variant=variant)


def _residual(scene: Scene) -> Model:
    return ResidualModel(scene, Size(4, 128))


DESIGNS = {
    "paper": Design(_paper, OF_NETWORKS),
    # Trained on 8 steps, by positions and rotations.
    "supertrack": Design(
        _supertrack,
        replace(OF_NETWORKS, curriculum=((2, 0.2), (8, 0.8)), loss=OF_NETWORKS.loss._replace(displacement=0.0)),
    ),
    "residual": Design(_residual, replace(OVER_PHYSICS, batch=256)),
    "physics": Design(ResidualModel, OVER_PHYSICS),  # without networks: nothing is trained
}


def _of_paper(**changed: object) -> Change:
    """Return a change of the paper's `Variant`."""

    def model(model: Model) -> Model:
        assert isinstance(model, PaperModel)
        return replace(model, variant=replace(model.variant, **changed))  # type: ignore[arg-type]

    return Change(model)


def _of_recipe(**changed: object) -> Change:
    return Change(recipe=lambda recipe: replace(recipe, **changed))  # type: ignore[arg-type]


def _layers(layers: int) -> Change:
    def model(model: Model) -> Model:
        if isinstance(model, PaperModel):
            return replace(model, sizes=replace(model.sizes, body=replace(model.sizes.body, layers=layers)))
        assert isinstance(model, ResidualModel) and model.size
        return replace(model, size=replace(model.size, layers=layers))

    return Change(model)


def _without_displacement(recipe: Recipe) -> Recipe:
    return replace(recipe, loss=recipe.loss._replace(displacement=0.0))


CHANGES = {
    "none": Change(),
    "unroll of 2 steps": _of_recipe(curriculum=((2, 1.0),)),
    "unroll of 20 from the start": _of_recipe(curriculum=((20, 1.0),)),
    "no displacement, input nor loss": Change(_of_paper(left_out=("displacement",)).model, _without_displacement),
    "no displacement input": _of_paper(left_out=("displacement",)),
    "no torque input": _of_paper(left_out=("torque",)),
    "quaternions": _of_paper(rotation="quaternion"),
    "root frame": _of_paper(root_frame=True, contact="none"),
    "accelerations": _of_paper(outputs="change"),
    "data not turned": _of_recipe(turned=False),
    "no batch dropped": _of_recipe(drop=float("inf")),
    "3 layers": _layers(3),
    "12 layers": _layers(12),
    "no stop-gradient": _of_recipe(stop_gradient=False),
    "contact impulse": _of_paper(contact="impulse"),
    "no contact network": _of_paper(contact="none"),
}
