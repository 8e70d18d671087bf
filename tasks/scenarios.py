"""Scenes on which the simulator is trained and evaluated, by name: the kick's, and the paper's diagnostic ones."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from larp_model.anatomy import KINDS
from larp_model.bodies import chain, detail_of, human_and_ball, human_and_capsule, two_balls, two_chains
from larp_model.designs import DesignName, SizeName
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.names import require_file, require_known
from larp_model.scene import Scene
from tasks.episodes.any_motion import any_episodes
from tasks.episodes.around_kick import STEPS, random_episodes
from tasks.episodes.chains import thrown_episodes
from tasks.motions import references
from tasks.pose.joint_motion import source_of

# The first n steps over which errors are averaged, as in the paper.
WINDOWS, CHAIN_WINDOWS = (10, 38, 60), (10, 40, 80, 190)


@dataclass(frozen=True)
class Scenario:
    """Scene, how its ground-truth episodes are drawn, and the paper's errors there.

    draw: returns episodes from (count, seed), and how many more were dropped; of so many steps where `steps` is given.
    windows: the first n steps over which errors are averaged. paper: mean position error [m] over the windows, by body.
    """

    name: str
    scene: Scene
    draw: Callable[..., tuple[Episodes, int]]
    windows: tuple[int, ...]
    paper: tuple[tuple[str, tuple[float, ...]], ...] = ()


def _kicking(scene: Scene) -> Scene:
    """Return a scene of a ball and a human, of the same detail as the scene's."""
    return human_and_ball(detail=detail_of(scene.body("human")))


def _embedded(scene: Scene) -> references.Reference:
    return references.embedded(_kicking(scene))


def _around_the_kick(
    scene: Scene, count: int, seed: int, steps: int = STEPS, varied: bool = False
) -> tuple[Episodes, int]:
    return random_episodes(scene, _embedded(scene), count, seed, steps, varied)


def _any_human(scene: Scene, count: int, seed: int, steps: int = STEPS) -> tuple[Episodes, int]:
    return any_episodes(scene, _embedded(scene), count, seed, steps)


def _human(name: str, scene: Scene, *paper: tuple[str, tuple[float, ...]]) -> Scenario:
    return Scenario(name, scene, partial(_around_the_kick, scene), WINDOWS, paper)


def _any(name: str, scene: Scene) -> Scenario:
    return Scenario(name, scene, partial(_any_human, scene), WINDOWS)


def _thrown(name: str, scene: Scene, *paper: float, varied: bool = True) -> Scenario:
    paper_errors = tuple((body.name, paper) for body in scene.bodies if paper)
    return Scenario(name, scene, partial(thrown_episodes, scene, varied=varied), CHAIN_WINDOWS, paper=paper_errors)


# The paper's tables 1 and 2.
SCENARIOS = {
    entry.name: entry
    for entry in (
        _human("human_ball", human_and_ball(), ("human", (0.010, 0.031, 0.048)), ("ball", (0.006, 0.033, 0.061))),
        _human(
            "human_capsule", human_and_capsule(), ("human", (0.010, 0.031, 0.050)), ("capsule", (0.010, 0.042, 0.069))
        ),
        _human("human", human_and_ball().only("human")),
        _any("any_human", human_and_ball(self_contact=True)),
        _any("any_human_alone", human_and_ball().only("human")),
        _any("full_human", human_and_ball(detail="full", self_contact=True)),
        _thrown("chain4", Scene((chain(links=4),))),
        _thrown("chains1", two_chains(1), 0.008, 0.021, 0.048, 0.173),
        _thrown("chains2", two_chains(2), 0.007, 0.023, 0.047, 0.137),
        _thrown("two_balls", two_balls(), varied=False),
    )
}


def around(chosen: Scenario, reference: Path | None, varied: bool) -> Scenario:
    """Return the scenario around a captured kick (see `references.captured`), or with varied bodies, or both."""
    if reference is None and not varied:
        return chosen
    if not any(body.kind in KINDS.values() for body in chosen.scene.bodies):
        argument = "reference" if reference else "bodies varied"
        raise InputError(f"{argument} is asked for, but the scene {chosen.name} has no human")
    if reference is None:
        return replace(chosen, draw=partial(_around_the_kick, chosen.scene, varied=True), paper=())
    kick = references.captured(source_of(reference), _kicking(chosen.scene))
    return replace(chosen, draw=partial(random_episodes, chosen.scene, kick, varied=varied), paper=())


def trained_at(name: str, design: DesignName | None = None, size: SizeName | None = None) -> Path:
    """Return the folder in which a run trains a scene's weights; design and size are named where they are given."""
    return Path("runs/train") / "_".join([name, *(part for part in (design, size) if part)])


def scenario(name: str) -> Scenario:
    """Return the scenario of this name, or the one that a Python file defines, FILE.py:NAME.

    In the file, which is executed, NAME is a `Scenario`, or a `Scene` without motors, whose bodies are thrown.
    """
    file, _, own = name.rpartition(":")
    if not file.endswith(".py"):
        require_known("scene", name, SCENARIOS)
        return SCENARIOS[name]
    require_file("scene", file)
    defined = runpy.run_path(file)
    scenes = [key for key, value in defined.items() if isinstance(value, Scene | Scenario)]
    require_known(f"scene is {name!r}: {own}", own, scenes)
    match defined[own]:
        case Scenario() as chosen:
            return chosen
        case scene if scene.motors:
            needed = "make it a tasks.scenarios.Scenario, whose draw says what moves them"
            raise InputError(f"scene is {name!r}, which has motors: {needed}")
        case scene:
            return _thrown(own.lower(), scene)
