"""Batches that devices share: rollouts, gradients and plans are those of one device, on each of several hosts."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np

PROGRAM = """
import sys
import jax

count, path, hosts = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
if hosts:
    jax.distributed.initialize(hosts[0], 2, int(hosts[1]))

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
assert len(rollout.sharding.device_set) == len(jax.local_devices()) == count
assert len(jax.devices()) == count * (2 if hosts else 1)
odd = simulator.rollout(states[:5], controls[:5])
gradient = jax.jit(jax.grad(lambda controls: jnp.sum(simulator.rollout(states, controls)[:, -1, :, :3])))(controls)
terms = [CostTerm("foot", lambda states, controls, context: states[-1, 1, :3] - context)]
planner = Planner(simulator, terms, 12, 4, 0.01, np.full((1, 3), 0.5), CEM(32, 2, 8))
window = Window(0.0, np.zeros((12, 1, 3)), np.array([0.3, 0.0, 0.3], np.float32))
plan, info = planner.step(planner.init(jax.random.key(0)), start, window)
np.savez(path, rollout=rollout, odd=odd, gradient=gradient, knots=plan.knots, costs=np.concatenate(info.costs))
"""


def start(path: Path, devices: int, *hosts: str) -> subprocess.Popen[bytes]:
    """Run the program: hosts are the coordinator's address and the process's number."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(devices), str(path), *hosts],
        env=os.environ | {"JAX_NUM_CPU_DEVICES": str(devices)},
        cwd=Path(__file__).parent,
    )


def test_each_of_two_hosts_with_eight_devices_gives_the_rollouts_gradients_and_plans_of_one(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    assert start(tmp_path / "one.npz", 1).wait(300) == 0
    hosts = [start(tmp_path / f"{number}.npz", 8, address, str(number)) for number in range(2)]
    assert [host.wait(300) for host in hosts] == [0, 0]
    one, *eight = (np.load(tmp_path / f"{name}.npz") for name in ("one", 0, 1))
    assert np.ptp(one["rollout"][:, -1, 1, 0]) > 0.01, "controls move nothing: there is little to compare"
    for results in eight:
        np.testing.assert_array_equal(one["odd"], results["odd"])
        for name in ("rollout", "gradient", "knots", "costs"):
            np.testing.assert_allclose(results[name], one[name], rtol=1e-4, atol=1e-4, err_msg=name)
