"""Engines that are compared on a GPU alone: MuJoCo Warp, and the paper's networks at their own size."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import jax
import mujoco
import numpy as np
from jax import Array

from larp_model.engines.mujoco import Truth, compile_model
from larp_model.learned.model import untrained_weights
from larp_model.learned.paper import PaperModel
from larp_model.scene import Scene
from larp_model.simulator import Simulator

# Most contacts of a pair of links that MuJoCo Warp is given room for.
CONTACTS = 4


class WarpTruth:
    """MuJoCo Warp with the same model as the ground truth; needs the extra `warp`. Steps as `Truth` does."""

    def __init__(self, scene: Scene, substeps: int, batch: int) -> None:
        """Compile its kernels, on a GPU as one graph; on a CPU that takes minutes."""
        import mujoco_warp
        import warp

        model = compile_model(scene, substeps)
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # which it has not
        self._engine, self._warp, self.substeps = mujoco_warp, warp, substeps
        self._starts = Truth(scene, batch, substeps, threads=1)
        self._model, data = mujoco_warp.put_model(model), mujoco.MjData(model)
        contacts = CONTACTS * len(model.pair_geom1)
        self._data = mujoco_warp.put_data(model, data, nworld=batch, nconmax=contacts, njmax=4 * contacts)
        self._advance()  # compiles
        self._graph = None
        if warp.get_device().is_cuda:
            with warp.ScopedCapture() as capture:
                self._advance()
            self._graph = capture.graph

    def _advance(self) -> None:
        for _ in range(self.substeps):
            self._engine.step(self._model, self._data)

    def reset(self, states: np.ndarray) -> None:
        """Put the simulations into states (N, L, 13)."""
        self._starts.reset(states)
        position, velocity = self._starts.coordinates()
        self._data.qpos.assign(position.astype(np.float32))
        self._data.qvel.assign(velocity.astype(np.float32))
        self._data.qacc_warmstart.zero_()

    def step(self, control: np.ndarray) -> np.ndarray:
        """Advance by a step under joint targets (N, J, 3) [rad]; return MuJoCo's coordinates (N, nq)."""
        self._data.ctrl.assign(np.ascontiguousarray(control, np.float32).reshape(len(control), -1))
        if self._graph is None:
            self._advance()
        else:
            self._warp.capture_launch(self._graph)
        self._warp.synchronize()
        coordinates: np.ndarray = self._data.qpos.numpy()
        return coordinates


def networks_of_paper(scene: Scene, precision: str | None = None) -> Callable[[Array, Array], Array]:
    """Return the step of the paper's model with random weights, which take as long as trained ones.

    precision: of the products of matrices, such as "bfloat16", which a GPU multiplies faster; single by default.
    """
    model = PaperModel(scene)
    simulator = Simulator.of(model, untrained_weights(model, jax.random.key(0)))

    def step(carry: Array, control: Array) -> Array:
        with jax.default_matmul_precision(precision) if precision else nullcontext():
            return simulator.step(carry, control)

    return step
