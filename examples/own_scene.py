"""Weights for a scene of your own: a club and a ball are thrown, learned, and rolled out from unseen initial states.

python examples/own_scene.py            # or: python -m tasks.train --scene examples/own_scene.py:CLUB_AND_BALL
"""

import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from larp_model import Pair, Scene, Simulator, Surface, ball, capsule
from tasks import train
from tasks.episodes.chains import thrown_episodes
from tasks.scenarios import Scenario

CLUB, BALL = capsule("club", length=0.6, radius=0.04, mass=0.8), ball()
CONTACT = Pair("club", "ball", ("capsule",), ("ball",), Surface(4000.0, 120.0, 1.0))
SCENE = Scene((CLUB, BALL), (CONTACT,))
# Name, scene, function that draws its ground truth, steps of 10 ms over which errors are averaged. Where bodies are to
# be thrown, and errors taken over 1.9 s, the scene alone suffices.
CLUB_AND_BALL = Scenario("club_and_ball", SCENE, partial(thrown_episodes, SCENE, steps=60), windows=(10, 40))
STEPS = 10


def main(effort: float = 0.05, episodes: int = 1000) -> None:
    """Train, then compare with MuJoCo; `effort=1, episodes=10000` for weights that are to be used."""
    name, folder = f"{__file__}:CLUB_AND_BALL", Path(tempfile.mkdtemp())
    train.main(name, folder=folder, episodes=episodes, effort=effort)
    simulator = Simulator.load(folder / "weights" / "club_and_ball.json", SCENE)
    true, _ = CLUB_AND_BALL.draw(64, 1_000_000)
    states = simulator.rollout(true.states[:, 0], true.controls[:, :STEPS], true.torques[:, :STEPS], true.morphology)
    apart = np.linalg.norm(np.asarray(states)[..., :3] - true.states[:, 1 : STEPS + 1, :, :3], axis=-1)
    print(f"after {STEPS} steps the links are {1000 * np.median(apart[:, -1]):.1f} mm from MuJoCo's (median)")
    assert np.median(apart[:, -1]) < 0.02


if __name__ == "__main__":
    main(*(kind(each) for kind, each in zip((float, int), sys.argv[1:], strict=False)))
