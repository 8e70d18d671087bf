"""Settings and fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator

import jax
import numpy as np
import pytest
from hypothesis import settings

from larp_model.bodies import human_and_ball
from larp_model.engines.episodes import Episodes
from larp_model.learned.model import Model
from larp_model.learned.paper import PaperModel, Sizes
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size, Weights
from larp_model.runtime import prepare_compiler
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.training import Recipe, Windows, statistics_of
from tasks.episodes.around_kick import random_episodes
from tasks.motions.references import Reference, embedded

# The first example of a property pays for compilation: no deadline. Every run tries the same examples.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True, scope="session")
def a_cache_of_this_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep compiled programs from one file of tests to the next, as commands keep them from run to run: here
    not in the user's cache, but in one that the processes of this run share.
    """
    workers = "PYTEST_XDIST_WORKER" in os.environ
    run = tmp_path_factory.getbasetemp().parent if workers else tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(run / "cache"))
        prepare_compiler()
        yield


@pytest.fixture(autouse=True, scope="session")
def garbage_is_collected_rarely() -> None:
    """Tracing makes many objects, among which Python would look for garbage again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)


@pytest.fixture(autouse=True, scope="module")
def nothing_compiled_is_kept() -> Iterator[None]:
    """Every compiled program keeps pages mapped, and of those a process may have 65 530: after some 1100 tests in one
    process the next compilation ends it. What a file of tests has compiled goes with it, and so does what it set.
    """
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    yield
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module")
def quick_compilation() -> Iterator[None]:
    """Compile without optimisation, for small problems, which take longer to compile than to solve."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="session")
def scene() -> Scene:
    """The kick's scene."""
    return human_and_ball()


@pytest.fixture(scope="session")
def reference(scene: Scene) -> Reference:
    """The embedded kick."""
    return embedded(scene)


@pytest.fixture(scope="session")
def episodes(scene: Scene, reference: Reference) -> Episodes:
    """64 truth episodes of 30 steps around the reference; in about half of them a foot meets the ball."""
    return random_episodes(scene, reference, count=64, seed=0, steps=30)[0]


LEAST = Size(2, 16)


@pytest.fixture(scope="session")
def residual(scene: Scene) -> Model:
    """The kind of model that ships, with networks as small as they can be."""
    return ResidualModel(scene, LEAST)


@pytest.fixture(scope="session")
def paper(scene: Scene) -> Model:
    """The paper's kind of model, as small as it can be."""
    return PaperModel(scene, Sizes(LEAST, LEAST, LEAST))


def random_weights(model: Model, episodes: Episodes) -> Weights:
    """Untrained weights with statistics of the truth."""
    with jax.enable_x64(False):
        windows = Windows(model.scene, [(episodes, 1.0)], Recipe(batch=64))
        return statistics_of(model, windows, np.random.default_rng(0), batches=2)


@pytest.fixture(scope="session")
def residual_weights(residual: Model, episodes: Episodes) -> Weights:
    """Random weights of `residual`."""
    return random_weights(residual, episodes)


@pytest.fixture(scope="session")
def paper_weights(paper: Model, episodes: Episodes) -> Weights:
    """Random weights of `paper`."""
    return random_weights(paper, episodes)


@pytest.fixture(scope="session")
def physics(scene: Scene) -> Simulator:
    """The kick's scene by physics alone."""
    return Simulator.of_physics(scene)
