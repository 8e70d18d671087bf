"""Fitting a network to a motion and a body: what is promised of the better of both, of training time, of bad input."""

import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from larp_model import training
from larp_model import weights as stored
from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.networks import Weights
from tasks import adapt
from tasks.adapt import Checked
from tasks.episodes.around_kick import random_episodes
from tasks.kick import Kick


def test_smaller_errors_are_better_and_the_same_are_not() -> None:
    usual = Checked((0.01, 0.04, 0.08), 0.08)
    assert Checked((0.006, 0.03, 0.05), 0.05).better_than(usual)
    assert Checked((0.006, 0.03, 0.05), math.nan).better_than(usual._replace(launch=math.nan))
    assert not usual.better_than(usual)
    assert not Checked((math.inf,) * 3, 0.05).better_than(usual)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"minutes": 0.5}, "minutes is 0.5, but must be at least 2"),
        ({"minutes": math.nan}, "minutes is nan, but must be at least 2"),
        ({"reference": Path("nowhere.bvh")}, "reference is 'nowhere.bvh', but no such file exists"),
        ({"height": -1.0}, "height is -1.0, but must be a positive finite number"),
    ],
)
def test_bad_input_is_refused_before_anything_is_drawn(
    given: dict[str, object], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=complaint):
        adapt.main(**({"out": tmp_path / "out"} | given))  # type: ignore[arg-type]
    assert not list((tmp_path / "out").glob("*.json"))


def test_adapting_writes_the_better_of_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("LEAST", 0.0), ("HELD_OUT", 8), ("DRAWN", 24), ("MOST", 24), ("CHECKING", 5.0), ("KICKS", 1)):
        monkeypatch.setattr(adapt, name, value)
    adapt.main(height=1.6, mass=50.0, minutes=1.0, size="tiny", out=tmp_path)
    content = json.loads((tmp_path / "adapted.json").read_text())["recipe"]
    before, after = (Checked(tuple(content[name]["human"]), content[name]["launch"]) for name in ("before", "after"))
    assert content["kept"] == ("after" if after.better_than(before) else "before")
    model, _, _ = stored.load(tmp_path / "adapted.json", human_and_ball(height=1.6, mass=50.0))
    assert bool(model.networks()) == (content["kept"] == "after")


def test_training_for_a_time_takes_that_time(residual: Model, residual_weights: Weights, tmp_path: Path) -> None:
    episodes, _ = random_episodes(residual.scene, Kick.standard().reference, 16, 4, steps=12)
    recipe = training.Recipe(100_000, 16, ((1, 1.0),))
    learned, log = training.train(residual, recipe, [(episodes, 1.0)], tmp_path, residual_weights, True, 8.0)
    assert log["seconds"] < 90.0 and training.TIMED < log["history"][-1]["update"] < 100_000
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), learned.networks, residual_weights.networks)
    assert any(jax.tree.leaves(moved))


def test_the_learning_rate_rises_from_nothing_and_falls_to_its_last_share() -> None:
    recipe = training.Recipe(updates=1000, learning_rate=2e-3, final=0.01)
    rates = [training.learning_rate(recipe, update) for update in range(1001)]
    assert rates[0] == 0.0 and max(rates) == pytest.approx(2e-3) and rates[1000] == pytest.approx(2e-5)
    top = int(np.argmax(rates))
    assert (np.diff(rates[: top + 1]) > 0.0).all() and (np.diff(rates[top:]) < 0.0).all()
