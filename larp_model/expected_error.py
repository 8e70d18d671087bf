"""Expected error of single steps, from the change of velocity that forces other than gravity cause in them.

Against converged MuJoCo, the mean distance of the links after a step grows in proportion to that change, whatever
causes it: motors, joints, the ground, a struck ball. `python -m tasks.benchmarks.stability` compares the two.
"""

from __future__ import annotations

from typing import Any

from larp_model import state as packed
from larp_model.scene import Scene

# Distance of the links from the ground truth, as a share of the displacement that the change of velocity adds: 0.030
# to 0.033 of humans who kick and of humans of any size in any motion, 0.038 of the full human, 0.05 to 0.07 of chains.
SHARE = 0.033
# Where nothing changes, square roots have a slope [(m/s)^2].
TINY = 1e-12


def expected_errors(scene: Scene, states: Any, morphology: Any) -> Any:
    """Return the errors (*, T) [m] to expect of T single steps by physics, as distances of the links in the mean.

    states: (*, T + 1, L, 13) before and after each step. morphology: (L, 3) or (*, L, 3). Arrays of NumPy or of JAX.
    Each error is of its step alone, from a true state: errors of steps before it add to the distance of a rollout.
    """
    xp = states.__array_namespace__()
    velocity, turning = (
        states[..., 1:, :, columns] - states[..., :-1, :, columns]
        for columns in (packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    fall = scene.gravity * scene.dt * xp.asarray([0.0, 0.0, 1.0], dtype=states.dtype)
    centre = xp.sqrt(xp.sum((velocity + fall) ** 2, axis=-1) + TINY)
    turn = xp.sqrt(xp.sum(turning**2, axis=-1) + TINY)
    reach = (0.5 * morphology[..., 0] + morphology[..., 1])[..., None, :]  # from the centre to the tip
    return SHARE * scene.dt * xp.mean(centre + reach * turn, axis=-1)
