"""Ground truth: a scene in MuJoCo, stepped in threaded batches, read and written as packed states.

A step of `scene.dt` takes several engine steps, because the engine's usual steps are not converged for a kick: see
`SUBSTEPS` and its test.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.runtime import cores
from larp_model.scene import Body, Link, Scene, Surface, anchor

# Halving the engine's step beyond this moves the ball's launch velocity by less than 1 % (median).
SUBSTEPS = 20
# Where plans are executed: over a whole kick the errors of swing and launch add up (`tasks.benchmarks.speed`).
FINE_SUBSTEPS = 80
# Distance from the origin beyond which a simulation counts as diverged [m].
FARTHEST = 1e3


def compile_model(scene: Scene, substeps: int = SUBSTEPS) -> mujoco.MjModel:
    """Return the MuJoCo model of a scene, its sensors laid out as the packed state."""
    if substeps < 1:
        raise InputError(f"substeps is {substeps!r}, but must be at least 1")
    spec = mujoco.MjSpec()
    spec.option.timestep = scene.dt / substeps
    spec.option.gravity = [0.0, 0.0, -scene.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    ground = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    ground.contype = ground.conaffinity = 0
    for body in scene.bodies:
        _add_body(spec, body)
    for pair in scene.pairs:
        for first in pair.first_links:
            for second in pair.second_links:
                _add_pair(spec, f"{pair.first}/{first}", f"{pair.second}/{second}", pair.surface)
    return spec.compile()


def _add_body(spec: mujoco.MjSpec, body: Body) -> None:
    bodies: list[mujoco.MjsBody] = []
    for index, link in enumerate(body.links):
        name = f"{body.name}/{link.name}"
        if index == 0:
            added = spec.worldbody.add_body(name=name)
            added.add_freejoint(name=name)
        else:
            joint = body.joints[index - 1]
            child_anchor = _anchor(link, joint.child_anchor)
            position = _anchor(body.links[joint.parent], joint.parent_anchor) - child_anchor
            added = bodies[joint.parent].add_body(name=name, pos=position)
            hinge = added.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_BALL, pos=child_anchor)
            hinge.damping[0] = joint.damping if joint.motor is None else joint.motor.damping
            if joint.motor is not None:
                hinge.armature = joint.motor.armature
                for axis in np.eye(3):
                    servo = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
                    servo.gear[:3] = axis
                    servo.set_to_position(kp=joint.motor.stiffness)
                    limit = joint.motor.torque_limit
                    servo.forcelimited, servo.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]
        bodies.append(added)
        reach = 0.5 * link.length * np.asarray(link.axis)
        geom = added.add_geom(name=name, mass=link.mass, contype=0, conaffinity=0)
        if link.length:
            geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, np.concatenate([-reach, reach])
        else:
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
        geom.size[0] = link.radius
        _add_pair(spec, "ground", name, body.surface)
    for added in bodies:
        for sensor in ("FRAMEPOS", "FRAMEQUAT", "FRAMELINVEL", "FRAMEANGVEL"):
            spec.add_sensor(
                type=getattr(mujoco.mjtSensor, f"mjSENS_{sensor}"),
                objtype=mujoco.mjtObj.mjOBJ_XBODY,
                objname=added.name,
            )


def _anchor(link: Link, point: tuple[float, float, float]) -> np.ndarray:
    return anchor(point, np.asarray(link.length), np.asarray(link.radius), link.axis)


def _add_pair(spec: mujoco.MjSpec, first: str, second: str, surface: Surface) -> None:
    pair = spec.add_pair(geomname1=first, geomname2=second, condim=3)
    pair.solref = [-surface.stiffness, -surface.damping]
    pair.solimp = [0.99, 0.99, 0.001, 0.5, 2.0]
    pair.friction[:2] = max(surface.friction, 1e-5)


class Truth:
    """A batch of simulations of one scene: the ground truth."""

    def __init__(self, scene: Scene, batch: int = 1, substeps: int = SUBSTEPS, threads: int = 0) -> None:
        """batch: simulations side by side. substeps: engine steps in one `scene.dt`. threads: 0 takes all `cores`."""
        self.scene = scene
        self.substeps = substeps
        self.threads = threads
        self.morphology: np.ndarray | None = None
        self.model = compile_model(scene, substeps)
        self._batch = Batch(self.model, nsim=batch, nthread=threads or cores())
        self._sensors = self._batch.bind("sensordata")  # refreshed by every call from here on
        self._joint = {name: self.model.joint(name).id for name in self._names()}
        self._bodies = [self.model.body(name).id for name in self._names()]  # the engine lists bodies depth first

    def __getstate__(self) -> dict[str, Any]:
        """Return the arguments and link sizes from which a copy is made; it begins anew and has to be reset."""
        return {
            "arguments": (self.scene, self.batch, self.substeps, self.threads),
            "morphology": self.morphology,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        if state["morphology"] is not None:
            self.resize(state["morphology"])

    def _names(self) -> list[str]:
        return [f"{body.name}/{link.name}" for body in self.scene.bodies for link in body.links]

    def resize(self, morphology: np.ndarray) -> None:
        """Give the links of each simulation their lengths [m], radii [m] and masses [kg], (N, L, 3); then `reset`."""
        needed = (self.batch, len(self.scene.links), 3)
        if np.shape(morphology) != needed:
            raise InputError(f"morphology has shape {np.shape(morphology)}, but needs {needed}")
        sizes, which = np.unique(np.asarray(morphology, float), axis=0, return_inverse=True)
        models = [compile_model(self.scene.sized(link_sizes), self.substeps) for link_sizes in sizes]
        self._batch.set_models([models[index] for index in which.ravel()])
        self.morphology = np.asarray(morphology, float)

    @property
    def batch(self) -> int:
        """Return how many simulations run side by side."""
        return int(self._batch.nsim)

    def state(self) -> np.ndarray:
        """Return the packed states (N, L, 13)."""
        return np.array(self._sensors).reshape(self.batch, -1, packed.SIZE)

    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return MuJoCo's own positions (N, nq) and velocities (N, nv), for engines that read its models."""
        return np.array(self._batch.bind("qpos")), np.array(self._batch.bind("qvel"))

    def reset(self, states: np.ndarray) -> None:
        """Put the simulations into the packed states (N, L, 13), or all into the one state (L, 13).

        Positions of links that are not roots follow from the joints: a state whose joints come apart is closed up.
        """
        states = np.broadcast_to(np.asarray(states, float), (self.batch, len(self.scene.links), packed.SIZE))
        batch = self._batch
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        rotation = Rotation.from_quat(states[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True)
        matrix = rotation.as_matrix().reshape(*states.shape[:2], 3, 3)
        omega = states[..., packed.ANGULAR_VELOCITY]
        parents = {child: parent for child, parent, _ in self.scene.joints()}
        for row, name in enumerate(self._names()):
            joint = self._joint[name]
            position, dof = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
            to_link = matrix[:, row].transpose(0, 2, 1)
            if row not in parents:
                qpos[:, position : position + 3] = states[:, row, packed.POSITION]
                qpos[:, position + 3 : position + 7] = states[:, row, packed.ORIENTATION]
                qvel[:, dof : dof + 3] = states[:, row, packed.VELOCITY]
                qvel[:, dof + 3 : dof + 6] = np.einsum("nij,nj->ni", to_link, omega[:, row])
            else:
                parent = parents[row]
                relative = Rotation.from_matrix(matrix[:, parent].transpose(0, 2, 1) @ matrix[:, row])
                qpos[:, position : position + 4] = relative.as_quat(scalar_first=True)
                qvel[:, dof : dof + 3] = np.einsum("nij,nj->ni", to_link, omega[:, row] - omega[:, parent])
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def step(self, control: np.ndarray, torque: np.ndarray | None = None) -> np.ndarray:
        """Advance by `scene.dt` under joint targets (N, J, 3) [rad] and torques on links (N, L, 3) [N m], world frame.

        Returns the packed states (N, L, 13), NaN for those that diverged: see `finite`.
        """
        self._batch.bind("ctrl")[:] = np.asarray(control).reshape(self.batch, -1)
        if torque is not None:
            self._batch.bind("xfrc_applied").reshape(self.batch, -1, 6)[:, self._bodies, 3:] = torque
        self._batch.step(nstep=self.substeps, stage=mujoco.mjtStage.mjSTAGE_VEL)
        states = self.state()
        states[~finite(states[:, None])] = np.nan
        return states

    def rollout(
        self, states: np.ndarray, controls: np.ndarray, torques: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Roll controls (N, H, J, 3) out from states (N, L, 13).

        Returns the states (N, H, L, 13) after each step, and a mask (N,) of the trajectories that did not diverge.
        """
        self.reset(states)
        steps = [
            self.step(controls[:, t], None if torques is None else torques[:, t]) for t in range(controls.shape[1])
        ]
        result = np.stack(steps, axis=1)
        return result, finite(result)


def closed(scene: Scene, states: np.ndarray, morphology: np.ndarray | None = None) -> np.ndarray:
    """Return states (N, L, 13) whose joints are closed: links other than roots are moved to their joints.

    morphology: (N, L, 3); the scene's by default.
    """
    result = np.array(states, float)
    usual = np.concatenate([body.sizes for body in scene.bodies])
    sizes = np.broadcast_to(usual if morphology is None else morphology, (*result.shape[:2], 3))
    links = scene.links
    rotations = Rotation.from_quat(result[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True)
    matrices = rotations.as_matrix().reshape(*result.shape[:2], 3, 3)

    def arm(row: int, point: tuple[float, float, float]) -> np.ndarray:
        local = anchor(point, sizes[:, row, 0], sizes[:, row, 1], links[row].axis)
        world: np.ndarray = np.einsum("nij,nj->ni", matrices[:, row], local)
        return world

    for child, parent, joint in scene.joints():
        near, far = arm(parent, joint.parent_anchor), arm(child, joint.child_anchor)
        parent_velocity, child_velocity = (
            np.cross(result[:, row, packed.ANGULAR_VELOCITY], reach) for row, reach in ((parent, near), (child, far))
        )
        result[:, child, packed.POSITION] = result[:, parent, packed.POSITION] + near - far
        result[:, child, packed.VELOCITY] = result[:, parent, packed.VELOCITY] + parent_velocity - child_velocity
    return result


def finite(states: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the trajectories (N, H, L, 13) that stayed finite and within physical limits."""
    near = (np.abs(states[..., packed.POSITION]) < FARTHEST).all(axis=(1, 2, 3))
    healthy: np.ndarray = near & packed.healthy(states).all(axis=1)
    return healthy
