"""The experiments: which runs each has, and what the paper says of them."""

from __future__ import annotations

from typing import NamedTuple

from tasks.experiments.changes import CHANGES


class Trial(NamedTuple):
    """A training: the scene, the design and its change, sequences of the ground truth, seed, and updates.

    Physics without networks has no sequences and no updates.
    """

    scene: str
    design: str
    change: str
    sequences: int
    seed: int
    updates: int

    @property
    def name(self) -> str:
        """Return the name of its folder."""
        words = (
            self.scene, self.design, self.change, f"{self.sequences} sequences", f"{self.updates} updates",
            f"seed {self.seed}",
        )  # fmt: skip
        return "_".join(words).replace(" ", "-").replace(",", "")


class Experiment(NamedTuple):
    """Runs that are compared, over windows of the first n steps.

    paper: what the paper reports, by (scene, design, change). windows: those of each scene by default; ground truth is
    then drawn of as many steps as it usually is. tracked: humans do not predict, but track a motion: see `tracked`.
    """

    title: str
    runs: tuple[Trial, ...]
    paper: dict[tuple[str, str, str], str]
    windows: tuple[int, ...] = ()
    tracked: bool = False


# Runs of networks and of what they correct: sequences, seeds, and updates, as two cores can do within three hours.
SEQUENCES, SEEDS, UPDATES = 2000, (0, 1, 2), 3000
OF_CONTACT = ("no stop-gradient", "contact impulse", "no contact network")
OF_DYNAMICS = tuple(name for name in CHANGES if name not in OF_CONTACT)
# Those that are made with a human, too, whose networks take longest.
OF_HUMAN = ("unroll of 2 steps", "no displacement, input nor loss", "accelerations", *OF_CONTACT)
OF_PHYSICS = ("none", "3 layers")


def _runs(
    scene: str, design: str, changes: tuple[str, ...] = ("none",), sequences: int = SEQUENCES, updates: int = UPDATES
) -> tuple[Trial, ...]:
    return tuple(Trial(scene, design, change, sequences, seed, updates) for change in changes for seed in SEEDS)


def _physics(*scenes: str) -> tuple[Trial, ...]:
    return tuple(Trial(scene, "physics", "none", 0, 0, 0) for scene in scenes)


EXPERIMENTS = {
    "ablations": Experiment(
        "Ablations",
        (
            *_runs("chain4", "paper", OF_DYNAMICS),
            *_runs("chains2", "paper", ("none", *OF_CONTACT)),
            *_runs("chain4", "residual", OF_PHYSICS),
            *_runs("chains2", "residual", OF_PHYSICS),
            *_runs("human_ball", "paper", ("none", *OF_HUMAN)),
            *_runs("human_ball", "residual", OF_PHYSICS),
            *_physics("chain4", "chains2", "human_ball"),
        ),
        {
            ("chain4", "paper", "none"): "0.11 m",
            ("chain4", "paper", "unroll of 2 steps"): "1.1 m",
            ("chain4", "paper", "no displacement, input nor loss"): "0.15 m, joints 0.061 m apart",
            ("chains2", "paper", "none"): "0.137 m",
            ("chains2", "paper", "no stop-gradient"): "differs much from run to run",
            ("chains2", "paper", "contact impulse"): "somewhat worse",
            ("human_ball", "paper", "none"): "0.048 m, ball 0.061 m",
        },
    ),
    "data": Experiment(
        "Data",
        (
            *(run for count in (1000, 4000, 16000, 64000) for run in _runs("chain4", "paper", sequences=count)),
            *(run for updates in (750, 12000) for run in _runs("chain4", "paper", sequences=16000, updates=updates)),
            *(run for count in (250, 1000, 4000, 16000) for run in _runs("chain4", "residual", sequences=count)),
            *(run for updates in (750, 12000) for run in _runs("chain4", "residual", sequences=16000, updates=updates)),
            *_physics("chain4"),
        ),
        {},
    ),
    "supertrack": Experiment(
        "Long sequences",
        (
            *(run for design in ("paper", "supertrack", "residual") for run in _runs("chain4", design)),
            *(run for design in ("paper", "supertrack", "residual") for run in _runs("any_human_alone", design)),
            *_physics("chain4", "any_human_alone"),
        ),
        {("any_human_alone", "paper", "none"): "joints 0.02 m apart after 1500 steps"},
        (20, 190, 500, 1500),
        tracked=True,
    ),
}
