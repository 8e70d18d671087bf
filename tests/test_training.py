"""Training: windows of the truth, a loss that falls, resuming, and bad batches that are dropped and counted."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread

from larp_model import training
from larp_model.bodies import chain
from larp_model.detection import first_contacts
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.learned.paper import PaperModel, Sizes
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size, Weights
from larp_model.scene import Scene
from larp_model.step_examples import examples_of, table_of
from larp_model.training import HISTORY, Batch, Recipe, Windows, history, statistics_of, train
from tasks.curve import curve_picture

SWING = Scene((chain(links=2),))
MODEL = PaperModel(SWING, Sizes(*[Size(2, 16)] * 3))  # which compiles soonest
SHORT = Recipe(updates=200, batch=16, curriculum=((2, 1.0),), learning_rate=3e-3)


@pytest.fixture(scope="module")
def swings() -> Episodes:
    """16 truth episodes of 20 steps of a tumbling chain."""
    starts = np.zeros((16, 2, 13))
    starts[..., 3], starts[..., 2] = 1.0, 3.0
    starts[..., 7:] = np.random.default_rng(0).standard_normal((16, 2, 6))
    return record(Truth(SWING, batch=16), starts, np.zeros((16, 20, 0, 3)))[0]


def test_examples_from_the_table_are_those_of_the_windows_drawn(swings: Episodes) -> None:
    model = ResidualModel(SWING, Size(2, 16))
    shorter = swings._replace(states=swings.states[:5, 7:], controls=swings.controls[:5, 7:])
    shorter = shorter._replace(torques=swings.torques[:5, 7:], morphology=swings.morphology[:5])
    windows = Windows(SWING, [(swings, 1.0), (shorter, 1.0)], dataclasses.replace(SHORT, batch=64))
    states, controls, torques, morphology = map(jnp.asarray, windows.draw(np.random.default_rng(3), 4))
    of_windows = examples_of(model, states[:, 0], states[:, 1], controls[:, 0], torques[:, 0], morphology)
    drawn = windows.draw_examples(table_of(model, windows.sources), np.random.default_rng(3), 4)
    for one, other in zip(jax.tree.leaves(drawn), jax.tree.leaves(of_windows), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)  # errors are differences of velocities


def same(first: Weights, second: Weights) -> bool:
    """Return whether two sets of weights are equal bit for bit."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, first, second)))


def test_a_window_is_an_unbroken_piece_of_one_episode() -> None:
    episode, step = np.mgrid[:5, :31]
    mark = (100.0 * episode + step)[..., None, None]
    sizes = np.arange(5.0)[:, None, None] * np.ones((1, 2, 3))
    torques = np.tile(mark[:, :-1], (1, 1, 2, 3))
    source = Episodes(np.tile(mark, (1, 1, 2, 13)), mark[:, :-1, :0].repeat(3, -1), torques, sizes)
    states, controls, torques, morphology = Windows(SWING, [(source, 1.0)], SHORT).draw(np.random.default_rng(0), 6)
    assert (states.shape, controls.shape, torques.shape) == ((16, 7, 2, 13), (16, 6, 0, 3), (16, 6, 2, 3))
    np.testing.assert_array_equal(np.diff(states[:, :, 0, 0], axis=1), 1.0)
    np.testing.assert_array_equal(torques[:, :, 0, 0], states[:, :-1, 0, 0])
    np.testing.assert_array_equal(morphology[:, 0, 0], states[:, 0, 0, 0] // 100)
    assert len(np.unique(states[:, 0, 0, 0])) > 8


def test_windows_near_contact_begin_shortly_before_it(scene: Scene, episodes: Episodes) -> None:
    recipe = Recipe(batch=64, contact_share=0.75, before_contact=3)
    drawn = Windows(scene, [(episodes, 1.0)], recipe).draw(np.random.default_rng(0), 5)
    found = first_contacts(scene, drawn, chunk=64)[:48]
    assert (found >= 0).all() and (found <= 3).all() and len(np.unique(found)) == 4


def test_sources_are_drawn_by_their_shares(swings: Episodes) -> None:
    marked = swings._replace(states=np.full_like(swings.states, 7.0))
    recipe = dataclasses.replace(SHORT, batch=4000)
    states, *_ = Windows(SWING, [(swings, 3.0), (marked, 1.0)], recipe).draw(np.random.default_rng(0), 1)
    assert np.mean(states[:, 0, 0, 0] == 7.0) == pytest.approx(0.25, abs=0.03)


def test_windows_longer_than_the_episodes_are_refused(swings: Episodes) -> None:
    with pytest.raises(InputError, match="episodes have 20 steps, but the unroll needs 21"):
        Windows(SWING, [(swings, 1.0)], SHORT).draw(np.random.default_rng(0), 21)


def test_the_curriculum_unrolls_as_it_says() -> None:
    recipe = Recipe(updates=100, curriculum=((2, 0.25), (8, 0.25), (20, 0.5)))
    assert [recipe.unroll(update) for update in (0, 24, 25, 49, 50, 99, 1000)] == [2, 2, 8, 8, 20, 20, 20]


@pytest.mark.parametrize(
    ("field", "value"), [("updates", 0), ("batch", 0), ("curriculum", ((4, 0.5),)), ("curriculum", ())]
)
def test_a_recipe_refuses_nonsense_by_field(field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"recipe.{field} is"):
        Recipe(**{field: value})  # type: ignore[arg-type]


def test_a_short_training_lowers_the_loss(paper: Model, episodes: Episodes, tmp_path: Path) -> None:
    recipe = Recipe(updates=200, batch=32, curriculum=((2, 1.0),), learning_rate=3e-3)
    weights, log = train(paper, recipe, [(episodes, 1.0)], tmp_path, quiet=True)
    losses = [row["loss"] for row in log["history"]]
    assert len(losses) == 2 and losses[-1] < 0.8 * losses[0]
    assert not log["stopped_early"] and log["history"][-1]["update"] == 200
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    (logged,) = (tmp_path / "tensorboard").iterdir()
    assert b"loss" in logged.read_bytes()
    curve_picture([tmp_path, tmp_path / "not begun"], tmp_path / "training.png")
    assert imread(tmp_path / "training.png").std() > 0.01


def test_a_training_cut_off_goes_on_as_if_it_had_not_been(
    swings: Episodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [(swings, 1.0)]
    whole, log = train(MODEL, SHORT, sources, tmp_path / "whole", quiet=True)
    assert [row["update"] for row in log["history"]] == [100, 200]
    # A clock on which a checkpoint is due at every hundredth update, and a cut while the first is being written.
    monkeypatch.setattr(training, "time", SimpleNamespace(perf_counter=count(0.0, 100.0).__next__))
    draw, drawn = Windows.draw, count()

    def cut_off(self: Windows, random: np.random.Generator, steps: int) -> Batch:
        if next(drawn) == 132:  # after 32 batches for the statistics and 100 updates
            raise KeyboardInterrupt
        return draw(self, random, steps)

    monkeypatch.setattr(Windows, "draw", cut_off)
    with pytest.raises(KeyboardInterrupt):
        train(MODEL, SHORT, sources, tmp_path / "cut", quiet=True)
    resumed, log = train(MODEL, SHORT, sources, tmp_path / "cut", quiet=True)
    assert [row["update"] for row in log["history"]] == [200], "the first hundred were not trained again"
    assert same(resumed, whole)
    with (tmp_path / "cut" / HISTORY).open("a") as file:
        file.write('{"update": 300, "lo')  # as by a process that was ended while it wrote
    again, totals = train(MODEL, SHORT, sources, tmp_path / "cut", quiet=True)
    assert not totals["history"] and same(again, whole)
    first, _ = history(tmp_path / "cut")
    assert totals["seconds"] == log["seconds"] > first["seconds"] > 0.0, "of both parts"


def measured(swings: Episodes) -> Weights:
    """Fresh weights with the statistics of sound episodes."""
    return statistics_of(MODEL, Windows(SWING, [(swings, 1.0)], SHORT), np.random.default_rng(1))


def test_bad_batches_are_dropped_and_counted(swings: Episodes, tmp_path: Path) -> None:
    states = swings.states.copy()
    states[3] = np.nan
    start, recipe = measured(swings), dataclasses.replace(SHORT, batch=8)
    before = jax.tree.map(np.array, start)
    sources = [(swings._replace(states=states), 1.0)]
    weights, log = train(MODEL, recipe, sources, tmp_path, start, quiet=True)
    drawn = [Windows(SWING, sources, recipe).draw(np.random.default_rng((0, i)), 2)[0] for i in range(200)]
    bad = sum(int(np.isnan(states).any()) for states in drawn)
    assert log["dropped"] == bad and 20 < bad < 180
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    assert not same(weights, before) and same(start, before), "training leaves the weights it starts from alone"


def test_training_on_bad_data_alone_stops_with_the_last_good_weights(swings: Episodes, tmp_path: Path) -> None:
    worthless = swings._replace(states=np.full_like(swings.states, np.nan))
    start = jax.tree.map(np.array, measured(swings))
    weights, log = train(MODEL, SHORT, [(worthless, 1.0)], tmp_path, start, quiet=True)
    assert log["stopped_early"] and log["dropped"] == 100 and same(weights, start)


def test_training_in_the_world_frame_turns_its_data(swings: Episodes, tmp_path: Path) -> None:
    recipe = dataclasses.replace(SHORT, updates=100)
    weights, log = train(MODEL, recipe, [(swings, 1.0)], tmp_path, quiet=True)
    assert log["dropped"] == 0 and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    spread = np.asarray(weights.inputs["dynamics/chain2"].mean)[2:32]
    assert np.abs(spread).max() < 3.0


IMPORT = """
import os, pkgutil, jax
before = dict(os.environ), dict(jax.config.values)
import larp_model
for module in pkgutil.walk_packages(larp_model.__path__, "larp_model."):
    __import__(module.name)
import jax._src.xla_bridge
assert not jax._src.xla_bridge.backends_are_initialized(), "an import has made arrays"
assert before == (dict(os.environ), dict(jax.config.values))
assert not os.listdir("."), os.listdir(".")
"""


def test_importing_the_model_has_no_side_effects(tmp_path: Path) -> None:
    paths: dict[str, Any] = {"cwd": tmp_path, "env": {"PYTHONPATH": str(Path(__file__).parents[1]), "HOME": "/"}}
    result = subprocess.run([sys.executable, "-c", IMPORT], **paths, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
