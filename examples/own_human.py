"""Humanoid of one's own, from an MJCF file: MuJoCo's, as it comes with MuJoCo's MJX; 41 kg on legs of 0.87 m.

Its capsules and hinges become our links and ball joints, or are refused by name: see `larp_model/mjcf.py`. It kicks at
once, planned by our physics or by MuJoCo.
"""

from pathlib import Path

import mujoco

from larp_model.bodies import ball, kicking
from larp_model.mjcf import humanoid
from tasks.kick import Kick
from tasks.session import Session

SOURCE = Path(mujoco.__file__).parent / "mjx/test_data/humanoid/humanoid.xml"
TARGET = (3.0, 0.3, 0.4)


def main() -> None:
    """Kick with this humanoid as with our human."""
    kick = Kick.of(kicking(humanoid(SOURCE), ball()))
    run = Session(kick).run(TARGET, "fast")
    print(f"missed by {100 * run.truth_error_m:.1f} cm at {run.summary['ball_speed_m_s']:.1f} m/s")
    assert run.truth_error_m < 0.25


if __name__ == "__main__":
    main()
