"""Batches that devices share: rollouts, gradients and plans are those of one device."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

PROGRAM = """
import sys
import jax
import jax.numpy as jnp
import numpy as np

from larp_model.scene import Scene
from larp_model.simulator import Simulator
from small_problems import LEG
from mpc import CEM, CostTerm, Planner, Window

simulator = Simulator.of_physics(Scene((LEG,)))
start = np.zeros((2, 13), np.float32)
start[:, 3] = 1.0
start[:, 2] = 0.75, 0.35
controls = np.random.default_rng(0).normal(0.0, 1.0, (32, 12, 1, 3)).astype(np.float32)
states = np.repeat(start[None], 32, axis=0)
rollout = simulator.rollout(states, controls)
assert len(rollout.sharding.device_set) == len(jax.devices()) == int(sys.argv[1])
odd = simulator.rollout(states[:5], controls[:5])
gradient = jax.jit(jax.grad(lambda controls: jnp.sum(simulator.rollout(states, controls)[:, -1, :, :3])))(controls)
terms = [CostTerm("foot", lambda states, controls, context: states[-1, 1, :3] - context)]
planner = Planner(simulator, terms, 12, 4, 0.01, np.full((1, 3), 0.5), CEM(32, 2, 8))
window = Window(0.0, np.zeros((12, 1, 3)), np.array([0.3, 0.0, 0.3], np.float32))
plan, info = planner.step(planner.init(jax.random.key(0)), start, window)
np.savez(sys.argv[2], rollout=rollout, odd=odd, gradient=gradient, knots=plan.knots, costs=np.concatenate(info.costs))
"""


def test_eight_devices_give_the_rollouts_gradients_and_plans_of_one(tmp_path: Path) -> None:
    results = []
    for count in (1, 8):
        path = tmp_path / f"{count}.npz"
        environment = os.environ | {"JAX_NUM_CPU_DEVICES": str(count)}
        subprocess.run(
            [sys.executable, "-c", PROGRAM, str(count), str(path)],
            check=True,
            env=environment,
            cwd=Path(__file__).parent,
        )
        results.append(np.load(path))
    one, eight = results
    assert np.ptp(one["rollout"][:, -1, 1, 0]) > 0.01, "controls move nothing: there is little to compare"
    np.testing.assert_array_equal(one["odd"], eight["odd"])
    for name in ("rollout", "gradient", "knots", "costs"):
        np.testing.assert_allclose(eight[name], one[name], rtol=1e-4, atol=1e-4, err_msg=name)
