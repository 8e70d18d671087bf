"""A humanoid of one's own, from an MJCF file: MuJoCo's, as it comes with MuJoCo's MJX; 41 kg on legs of 0.87 m.

Its capsules and hinges become our links and ball joints, or are refused by name: see `larp_model/mjcf.py`. It kicks at
once, planned by our physics or by MuJoCo.
"""

from dataclasses import replace
from pathlib import Path

import mujoco

from larp_model.bodies import ball, kicking
from larp_model.mjcf import humanoid
from mpc import CEM
from tasks.kick import Kick
from tasks.presets import preset_of

SOURCE = Path(mujoco.__file__).parent / "mjx/test_data/humanoid/humanoid.xml"
TARGET = (3.0, 0.3, 0.4)
# Few candidates, for MuJoCo takes its time; afterwards it stands by itself, or falls.
PRESET = replace(preset_of("fast"), stand=(CEM(samples=16, rounds=1, elites=8),))


def main() -> None:
    """It kicks as our human does, planned by MuJoCo; the learned model says why it will not."""
    kick = Kick.of(kicking(humanoid(SOURCE), ball()))
    run = kick.to(TARGET, PRESET, "mujoco")
    print(f"missed by {100 * run.truth_error_m:.1f} cm at {run.summary['ball_speed_m_s']:.1f} m/s")
    assert run.truth_error_m < 0.25
    try:
        kick.planners("fast", "larp")
    except ValueError as error:
        print(error)
        assert "do not fit the scene" in str(error)
    else:
        raise AssertionError("weights of another human were taken")


if __name__ == "__main__":
    main()
