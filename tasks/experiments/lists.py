"""The experiments: which runs each has, and what the paper says of them."""

from __future__ import annotations

from typing import NamedTuple

from tasks.experiments.changes import CHANGES


class Trial(NamedTuple):
    """A training: the scene, the design and its change, sequences of the ground truth, seed, and updates."""

    scene: str
    design: str
    change: str
    sequences: int
    seed: int
    updates: int

    @property
    def name(self) -> str:
        """Return the name of its folder."""
        words = (self.scene, self.design, self.change, f"{self.sequences} sequences", f"seed {self.seed}")
        return "_".join(words).replace(" ", "-").replace(",", "")


class Experiment(NamedTuple):
    """Runs that are compared, over windows of the first n steps.

    paper: what the paper reports, by (scene, design, change). steps: of the ground truth that runs are judged by.
    """

    title: str
    runs: tuple[Trial, ...]
    paper: dict[tuple[str, str, str], str]
    windows: tuple[int, ...]
    steps: int = 200


# Runs of networks and of what they correct: sequences, seeds, and updates, as two cores can do within three hours.
SEQUENCES, SEEDS, UPDATES = 2000, (0, 1, 2), 3000
OF_CONTACT = ("no stop-gradient", "contact impulse", "no contact network")
OF_DYNAMICS = tuple(name for name in CHANGES if name not in OF_CONTACT)
OF_PHYSICS = ("none", "3 layers")


def _runs(scene: str, design: str, changes: tuple[str, ...], sequences: int = SEQUENCES) -> tuple[Trial, ...]:
    return tuple(Trial(scene, design, change, sequences, seed, UPDATES) for change in changes for seed in SEEDS)


EXPERIMENTS = {
    "ablations": Experiment(
        "Ablations",
        (
            *_runs("chain4", "paper", OF_DYNAMICS),
            *_runs("chains2", "paper", ("none", *OF_CONTACT)),
            *_runs("chain4", "residual", OF_PHYSICS),
            *_runs("chains2", "residual", OF_PHYSICS),
        ),
        {
            ("chain4", "paper", "none"): "0.11 m",
            ("chain4", "paper", "unroll of 2 steps"): "1.1 m",
            ("chain4", "paper", "no displacement, input nor loss"): "0.15 m, joints 0.061 m apart",
            ("chains2", "paper", "none"): "0.137 m",
            ("chains2", "paper", "no stop-gradient"): "differs much from run to run",
            ("chains2", "paper", "contact impulse"): "somewhat worse",
        },
        (10, 40, 80, 190),
    ),
    "data": Experiment(
        "Data",
        tuple(
            run
            for sequences in (250, 1000, 4000, 16000)
            for design in ("paper", "residual")
            for run in _runs("chain4", design, ("none",), sequences)
        ),
        {},
        (10, 40, 80, 190),
    ),
    "supertrack": Experiment(
        "Long sequences",
        tuple(run for design in ("paper", "supertrack", "residual") for run in _runs("chain4", design, ("none",))),
        {("chain4", "paper", "none"): "joints 0.02 m apart after 1500 steps"},
        (20, 190, 500, 1500),
        1500,
    ),
}
