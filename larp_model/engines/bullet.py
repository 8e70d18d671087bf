"""A second ground truth: the same scene in Bullet, to separate physics from properties of one engine.

Bullet has no batched stepping: the worlds of a batch are stepped one after the other, each in a client of its own that
takes about 34 MB. Differences from MuJoCo, and how its parameters follow from the scene:

Servos are torques, as in MuJoCo: clip(stiffness * (target - rotation vector)) - damping * relative velocity on each
axis of the child. They are computed once an engine step and constant over it, where MuJoCo takes the damping
implicitly. For stability, the moments of inertia of a link have a lower bound, given by the servos at its joints and
the step; of the human it affects the pelvis alone at the default step, and nothing at half of it.

Armature is inertia against turning relative to the parent, which Bullet lacks. It is added to the inertia of the child,
so that contacts act on it too, but there it also resists turning together with the parent.

Contacts are springs and dampers in N/m and N s/m where a `Surface` has both per unit of effective mass; the mass of
the whole body stands for it against the ground, and that of the lighter body between two bodies. Bullet joins the
springs of two links in series, so one of the two carries the surface and the other is hard: the lighter body of a
pair, the ground under all others. Hence a pair must have the surface of its lighter body. Bullet's springs are
implicit and lose energy to the step; stiffness and damping are such that a free bounce in these steps is the exact one,
and the engine step is divided further, under the same torques, where only a negative damping could do that.

Friction holds at once, up to Coulomb's limit. MuJoCo's takes hold at the rate of the surface's damping, which for a
football is slower than a kick: there the ball leaves the foot with less angular velocity.
"""

from __future__ import annotations

import math
import weakref
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.mujoco import SUBSTEPS, finite
from larp_model.errors import InputError
from larp_model.scene import Body, Link, Scene, Surface, Vector, anchor

HARD = 1e18  # stiffness of a rigid surface [N/m]
FASTEST = 1e4  # limit of joint velocities, by default 100 in Bullet [m/s, rad/s]
DIVISIONS = 64  # of an engine step, at most: a surface without damping would need infinitely many


class Compliance(NamedTuple):
    """The compliance of a surface in Bullet. stiffness: [N/m]. damping: [N s/m]."""

    stiffness: float
    damping: float


def compliance(surface: Surface, mass: float, step: float) -> Compliance:
    """Return the spring and damper whose free contact, in implicit steps of `step` [s], follows the surface's exactly.

    An implicit step of v' = -k x - c v, c = damping + k step, multiplies states by a matrix of determinant b and of
    trace 1 + b - k b step^2 / mass, b = 1 / (1 + c step / mass), which are those of the exact motion.
    """
    decay = 0.5 * surface.damping
    square = surface.stiffness - decay**2
    swing = math.cos(math.sqrt(square) * step) if square >= 0.0 else math.cosh(math.sqrt(-square) * step)
    shrunk = math.exp(-2.0 * decay * step)
    stiffness = mass * (1.0 + shrunk - 2.0 * math.exp(-decay * step) * swing) / (shrunk * step**2)
    return Compliance(stiffness, mass * (1.0 / shrunk - 1.0) / step - stiffness * step)


def inertia(link: Link) -> np.ndarray:
    """Return moments of inertia (3,) of a capsule of uniform density [kg m^2]: twice across its axis, then along it."""
    length, radius = link.length, link.radius
    cylinder = link.mass * length / (length + 4.0 / 3.0 * radius)
    caps = link.mass - cylinder
    across = cylinder * (length**2 / 12.0 + radius**2 / 4.0)
    across += caps * (0.4 * radius**2 + 0.25 * length**2 + 0.375 * length * radius)
    return np.array([across, across, (0.5 * cylinder + 0.4 * caps) * radius**2])


def _principal(link: Link) -> np.ndarray:
    """Return the rotation (3, 3) from a frame whose z lies along the capsule to the link's frame."""
    axis = np.asarray(link.axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(axis, across), axis])


def _divisions(surface: Surface, step: float) -> int:
    """Return the number of parts of an engine step of `step` [s] at which no damping of a surface is negative."""
    counts = (count for count in range(1, DIVISIONS) if compliance(surface, 1.0, step / count).damping >= 0.0)
    return next(counts, DIVISIONS)


class _Tree(NamedTuple):
    """A body in Bullet: link frames at the joints, inertia and collision shapes along the capsules.

    rows: of its links in the state. soft: whether it carries its surface; else the ground under it does.
    principal: (L, 3, 3) from the frame along the capsule, which Bullet uses for rotations, to the link's frame.
    stiffness, limit, damping: (L - 1, 1) of the joints; [N m/rad], [N m], [N m s/rad]. motors: joints with a motor.
    """

    body: Body
    rows: slice
    mass: float
    soft: bool
    principal: np.ndarray
    stiffness: np.ndarray
    limit: np.ndarray
    damping: np.ndarray
    motors: np.ndarray
    targets: slice


def _tree(scene: Scene, body: Body, soft: bool) -> _Tree:
    passive = [0.0, math.inf]
    motors = [joint.motor for joint in body.joints]
    stiffness_and_limit = [[motor.stiffness, motor.torque_limit] if motor else passive for motor in motors]
    servo = np.array(stiffness_and_limit, float).reshape(-1, 2, 1)
    damping = [motor.damping if motor else joint.damping for motor, joint in zip(motors, body.joints, strict=True)]
    return _Tree(
        body,
        scene.rows(body.name),
        sum(link.mass for link in body.links),
        soft,
        np.stack([_principal(link) for link in body.links]),
        servo[:, 0],
        servo[:, 1],
        np.array(damping, float).reshape(-1, 1),
        np.flatnonzero([motor is not None for motor in motors]),
        scene.motor_rows(body.name),
    )


def _stable_inertia(tree: _Tree, row: int, step: float) -> np.ndarray:
    """Return moments of inertia (3,) [kg m^2] of a link and its armature, raised so that engine steps are stable."""
    joints, moments = tree.body.joints, inertia(tree.body.links[row])
    if row:
        motor = joints[row - 1].motor
        moments += motor.armature if motor else 0.0
    # Explicit damping is stable where a step of it removes at most the velocity at both its ends.
    at_link = [i for i, joint in enumerate(joints) if row in (i + 1, joint.parent)]
    stable: np.ndarray = np.maximum(moments, step * (tree.damping[at_link] + step * tree.stiffness[at_link]).sum())
    return stable


def _soft_bodies(scene: Scene) -> set[str]:
    """Return the names of the bodies that carry the surface of their contacts: the lighter one of each pair."""
    masses = {body.name: sum(link.mass for link in body.links) for body in scene.bodies}
    lighter = {pair: min(pair.second, pair.first, key=masses.__getitem__) for pair in scene.pairs}
    soft = set(lighter.values())
    for pair, name in lighter.items():
        if pair.surface != scene.body(name).surface:
            raise InputError(
                f"scene.pairs gives {pair.first!r} and {pair.second!r} the surface {pair.surface}, but Bullet needs "
                f"that of the lighter one, {name!r}: {scene.body(name).surface}"
            )
        if {pair.first, pair.second} <= soft:
            raise InputError(
                f"scene.pairs ties {pair.first!r} and {pair.second!r}, but in Bullet one of them must not be the "
                "lighter one of any pair"
            )
    return soft


class _World:
    """One simulation: a physics client with the scene's bodies and a ground for each of them."""

    def __init__(self, engine: Any, scene: Scene, trees: list[_Tree], step: float, divisions: int) -> None:
        self._engine, self._trees = engine, trees
        self._client = engine.connect(engine.DIRECT)
        if self._client < 0:
            raise InputError("batch is more than the simulations that pybullet can hold at once")
        self._end = weakref.finalize(self, engine.disconnect, self._client)
        self.call("setGravity", 0.0, 0.0, -scene.gravity)
        self.call("setPhysicsEngineParameter", fixedTimeStep=step, numSubSteps=divisions, enableConeFriction=1)
        self._bodies = [self._add(tree, step, step / divisions) for tree in trees]
        bodies = {tree.body.name: (tree.body, index) for tree, index in zip(trees, self._bodies, strict=True)}
        for pair in scene.pairs:
            (first, one), (second, other) = bodies[pair.first], bodies[pair.second]
            for this, that in product(pair.first_links, pair.second_links):
                self.call("setCollisionFilterPair", one, other, first.link(this) - 1, second.link(that) - 1, 1)
        self._fresh = self.call("saveState")

    def call(self, name: str, *arguments: Any, **options: Any) -> Any:
        """Call a function of the engine for this world."""
        return getattr(self._engine, name)(*arguments, **options, physicsClientId=self._client)

    def close(self) -> None:
        """Release the client; it is released by itself with the world or with the interpreter."""
        self._end()

    def _create(self, tree: _Tree) -> int:
        """Create a body's links and joints; return its number in the engine."""
        engine, links, joints = self._engine, tree.body.links, tree.body.joints
        anchors = [np.zeros(3)] + [_anchor(links[i], joint.child_anchor) for i, joint in enumerate(joints, start=1)]
        along = [Rotation.from_matrix(matrix).as_quat() for matrix in tree.principal]
        shapes = [
            self.call(
                "createCollisionShape",
                engine.GEOM_CAPSULE if link.length else engine.GEOM_SPHERE,
                radius=link.radius,
                **({"height": link.length} if link.length else {}),
                collisionFramePosition=-anchor,
                collisionFrameOrientation=orientation,
            )
            for link, anchor, orientation in zip(links, anchors, along, strict=True)
        ]
        return int(
            self.call(
                "createMultiBody",
                links[0].mass,
                shapes[0],
                -1,
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                baseInertialFrameOrientation=along[0],
                linkMasses=[link.mass for link in links[1:]],
                linkCollisionShapeIndices=shapes[1:],
                linkVisualShapeIndices=[-1] * len(joints),
                linkPositions=[_anchor(links[j.parent], j.parent_anchor) - anchors[j.parent] for j in joints],
                linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * len(joints),
                linkInertialFramePositions=[-anchor for anchor in anchors[1:]],
                linkInertialFrameOrientations=along[1:],
                linkParentIndices=[joint.parent for joint in joints],
                linkJointTypes=[engine.JOINT_SPHERICAL] * len(joints),
                linkJointAxis=[[0.0, 0.0, 1.0]] * len(joints),
                flags=engine.URDF_MAINTAIN_LINK_ORDER,
            )
        )

    def _add(self, tree: _Tree, step: float, division: float) -> int:
        """Add a body with its own ground, and let them alone touch."""
        engine, index = self._engine, self._create(tree)
        # Bullet forgets what else a call sets on a link where it sets these too.
        self.call("changeDynamics", index, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=FASTEST)
        ground = self.call("createMultiBody", 0.0, self.call("createCollisionShape", engine.GEOM_PLANE))
        friction = tree.body.surface.friction
        spring = compliance(tree.body.surface, tree.mass, division)
        hard = (1.0, HARD, 0.0)
        soft = (friction, spring.stiffness, max(spring.damping, 0.0))
        self._touch(ground, -1, *(hard if tree.soft else soft))
        for link in range(-1, len(tree.body.joints)):
            if link >= 0:
                self.call(  # a spherical joint comes with a motor that brakes it
                    "setJointMotorControlMultiDof",
                    index,
                    link,
                    engine.POSITION_CONTROL,
                    targetPosition=[0.0, 0.0, 0.0, 1.0],
                    positionGain=0.0,
                    velocityGain=1.0,
                    force=[0.0, 0.0, 0.0],
                )
            self._touch(index, link, *(soft if tree.soft else hard))
            self.call("changeDynamics", index, link, localInertiaDiagonal=_stable_inertia(tree, link + 1, step))
            self.call("setCollisionFilterPair", ground, index, -1, link, 1)
        return index

    def _touch(self, index: int, link: int, friction: float, stiffness: float, damping: float) -> None:
        """Set a link's friction and compliance, and let it collide with what is named alone."""
        self.call("setCollisionFilterGroupMask", index, link, 0, 0)
        self.call(
            "changeDynamics",
            index,
            link,
            lateralFriction=friction,
            restitution=0.0,
            contactStiffness=stiffness,
            contactDamping=damping,
        )

    def state(self) -> np.ndarray:
        """Return the packed state (L, 13)."""
        parts = []
        for tree, index in zip(self._trees, self._bodies, strict=True):
            pose, motion = self.call("getBasePositionAndOrientation", index), self.call("getBaseVelocity", index)
            rows = [[*pose[0], *pose[1], *motion[0], *motion[1]]]
            if tree.body.joints:
                children = list(range(len(tree.body.joints)))
                for link in self.call("getLinkStates", index, children, 1, 1):
                    rows.append([*link[0], *link[1], *link[6], *link[7]])
            parts.append(np.array(rows))
            along = Rotation.from_quat(parts[-1][:, packed.ORIENTATION])
            orientation = along * Rotation.from_matrix(tree.principal).inv()
            parts[-1][:, packed.ORIENTATION] = orientation.as_quat(canonical=True, scalar_first=True)
        return np.concatenate(parts)

    def reset(self, state: np.ndarray) -> None:
        """Put the world into the packed state (L, 13), with no memory of earlier contacts."""
        self.call("restoreState", self._fresh)
        for tree, index in zip(self._trees, self._bodies, strict=True):
            body_state = state[tree.rows]
            rotation = Rotation.from_quat(body_state[:, packed.ORIENTATION], scalar_first=True)
            along = Rotation.from_matrix(tree.principal)
            omega = body_state[:, packed.ANGULAR_VELOCITY]
            base = (rotation[0] * along[0]).as_quat()
            self.call("resetBasePositionAndOrientation", index, body_state[0, packed.POSITION], base)
            self.call("resetBaseVelocity", index, body_state[0, packed.VELOCITY], omega[0])
            if tree.body.joints:
                parents = [joint.parent for joint in tree.body.joints]
                inward = along[1:].inv()
                relative = inward * rotation[parents].inv() * rotation[1:] * along[1:]
                angular_velocity = (inward * rotation[1:].inv()).apply(omega[1:] - omega[parents])
                children = list(range(len(parents)))
                self.call(
                    "resetJointStatesMultiDof", index, children, relative.as_quat().tolist(), angular_velocity.tolist()
                )

    def step(self, substeps: int, control: np.ndarray, torque: np.ndarray) -> None:
        """Take engine steps under joint targets (J, 3) [rad] and torques on links (L, 3) [N m], world frame."""
        targets = []
        for tree in self._trees:
            target = np.zeros((len(tree.body.joints), 3))
            target[tree.motors] = control[tree.targets]
            targets.append(target)
        for _ in range(substeps):
            for tree, index, target in zip(self._trees, self._bodies, targets, strict=True):
                if tree.body.joints:
                    self._drive(tree, index, target)
                for link in np.flatnonzero(torque[tree.rows].any(axis=1)):
                    link_torque = torque[tree.rows][link].tolist()
                    self.call("applyExternalTorque", index, int(link) - 1, link_torque, self._engine.WORLD_FRAME)
            self.call("stepSimulation")

    def _drive(self, tree: _Tree, index: int, target: np.ndarray) -> None:
        """Apply the torques of servos and dampers to the joints, targets (J, 3) [rad]."""
        joints = list(range(len(tree.body.joints)))
        joint_states = self.call("getJointStatesMultiDof", index, joints)
        inner = tree.principal[1:]
        quaternions, rates = (np.array([joint[column] for joint in joint_states]) for column in (0, 1))
        rotation_vectors = np.einsum("jab,jb->ja", inner, _rotation_vector(quaternions))
        angular_velocity = np.einsum("jab,jb->ja", inner, rates)
        torques = np.clip(tree.stiffness * (target - rotation_vectors), -tree.limit, tree.limit)
        torques = np.einsum("jab,ja->jb", inner, torques - tree.damping * angular_velocity)
        mode = self._engine.TORQUE_CONTROL
        self.call("setJointMotorControlMultiDofArray", index, joints, mode, forces=torques.tolist())


def _anchor(link: Link, point: Vector) -> np.ndarray:
    return anchor(point, np.asarray(link.length), np.asarray(link.radius), link.axis)


def _rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Return rotation vectors (*, 3) [rad] of quaternions (*, 4) x, y, z, w; SciPy takes longer than a step."""
    vector, scalar = quaternion[:, :3], quaternion[:, 3:]
    size = np.sqrt((vector * vector).sum(axis=1, keepdims=True))
    angle = 2.0 * np.arctan2(size, np.abs(scalar))
    rotation_vector: np.ndarray = vector * np.copysign(angle / np.maximum(size, 1e-300), scalar)
    return rotation_vector


class BulletTruth:
    """A batch of simulations of one scene, one world after the other; see `larp_model.engines.mujoco.Truth`."""

    def __init__(self, scene: Scene, batch: int = 1, substeps: int = SUBSTEPS) -> None:
        """batch: simulations side by side. substeps: engine steps in one `scene.dt`, each with its own torques."""
        self._worlds: list[_World] = []
        for name, value in (("batch", batch), ("substeps", substeps)):
            if value < 1:
                raise InputError(f"{name} is {value!r}, but must be at least 1")
        self.scene = scene
        self.substeps = substeps
        self._fill([scene] * batch)

    def _fill(self, scenes: list[Scene]) -> None:
        """Make a simulation of each of the scenes."""
        try:
            import pybullet
        except ImportError:
            raise InputError("pybullet is not installed: pip install 'larp-mpc[bullet]'") from None
        self.close()
        step = self.scene.dt / self.substeps
        divisions = max(_divisions(body.surface, step) for body in self.scene.bodies)
        for scene in scenes:
            soft = _soft_bodies(scene)
            trees = [_tree(scene, body, body.name in soft) for body in scene.bodies]
            self._worlds.append(_World(pybullet, scene, trees, step, divisions))

    def resize(self, morphology: np.ndarray) -> None:
        """Give the links of each simulation their lengths [m], radii [m] and masses [kg], (N, L, 3); then `reset`."""
        needed = (self.batch, len(self.scene.links), 3)
        if np.shape(morphology) != needed:
            raise InputError(f"morphology has shape {np.shape(morphology)}, but needs {needed}")
        self._fill([self.scene.sized(sizes) for sizes in morphology])

    def close(self) -> None:
        """Release the engine's memory, and with it the simulations."""
        while self._worlds:
            self._worlds.pop().close()

    @property
    def batch(self) -> int:
        """Return the number of simulations."""
        return len(self._worlds)

    def state(self) -> np.ndarray:
        """Return the packed states (N, L, 13); of the two quaternions of an orientation, that with w >= 0."""
        return np.stack([world.state() for world in self._worlds])

    def reset(self, states: np.ndarray) -> None:
        """Put the simulations into the packed states (N, L, 13), or all into the one state (L, 13).

        Positions of links that are not roots follow from the joints: a state whose joints come apart is closed up.
        """
        states = np.broadcast_to(np.asarray(states, float), (self.batch, len(self.scene.links), packed.SIZE))
        for world, state in zip(self._worlds, states, strict=True):
            world.reset(state)

    def step(self, control: np.ndarray, torque: np.ndarray | None = None) -> np.ndarray:
        """Advance by `scene.dt` under joint targets (N, J, 3) [rad] and torques on links (N, L, 3) [N m], world frame.

        Returns the packed states (N, L, 13).
        """
        control = np.asarray(control, float).reshape(self.batch, -1, 3)
        torque = np.zeros((self.batch, len(self.scene.links), 3)) if torque is None else np.asarray(torque, float)
        for world, targets, torques in zip(self._worlds, control, torque, strict=True):
            world.step(self.substeps, targets, torques)
        return self.state()

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
