"""Reference of one's own: a BVH file, an npz file, or arrays of joint angles.

    python examples/own_reference.py [kick.bvh or kick.npz]

Without a file, the project's own kick with a deeper lean of the torso is written as an npz file and taken from there.
"""

import sys
from pathlib import Path

import numpy as np

from larp_model import state as packed
from tasks.kick import Kick
from tasks.session import Session

TARGET = (4.0, 0.4, 0.4)


def leaning(path: Path) -> None:
    """Write the embedded kick as joint angles, with the torso bent by 0.1 rad more."""
    kick = Kick.standard()
    human, states = kick.scene.human, kick.reference.states
    angles = human.angles(states[:, : len(human.links), packed.ORIENTATION])
    angles[:, human.link("torso") - 1, 1] += 0.1
    np.savez(
        path,
        rate=1.0 / kick.scene.dt,  # frames a second
        position=states[:, 0, packed.POSITION],  # of the pelvis (T, 3) [m], z up
        orientation=states[:, 0, packed.ORIENTATION],  # of the pelvis (T, 4), w x y z
        angles=angles,  # rotation vectors (T, joints, 3) [rad], child in parent
        joints=[link.name for link in human.links[1:]],
    )


def main(file: str | None = None) -> None:
    """Kick near the reference in the file."""
    path = Path(file or "runs/leaning.npz")
    if file is None:
        path.parent.mkdir(exist_ok=True)
        leaning(path)
    run = Session(Kick.standard(path)).run(TARGET, "fast")
    print(f"{path}: missed by {100 * run.truth_error_m:.1f} cm, {run.summary['reference_deviation_m']:.3f} m off it")
    assert run.truth_error_m < 0.5 and not run.summary["fell"]


if __name__ == "__main__":
    main(*sys.argv[1:])
