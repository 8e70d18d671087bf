"""Reference kicks: the embedded one, from key poses, and captured ones, both performed in the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import bodies
from larp_model import state as packed
from larp_model.bodies import standing_height
from larp_model.engines.mujoco import Truth, closed, finite
from larp_model.errors import InputError
from larp_model.rotation import turned_about_z
from larp_model.scene import Body, Link, Scene
from tasks.motions import angles, bvh, key_poses, skeleton
from tasks.motions.details import in_detail
from tasks.motions.key_poses import KeyPoses
from tasks.motions.skeleton import Motion
from tasks.motions.tracking import Tracker

# Steps around the strike in which a captured kick may hit its ball.
STRIKE_STEPS = 10
# Joints of captured kicks are at most 0.1 rad beyond a human's bounds, in the mean; those of a skeleton that is
# misunderstood far more.
MOST_BEYOND = 0.3
# Least height of the hips above the lower foot at the strike, as a share of the rest pose's.
MIN_HIP_HEIGHT = 0.5


@dataclass(frozen=True, eq=False)
class Reference:
    """Kick that plans stay near to, as the servo-driven human performs it in the ground truth.

    states: (T + 1, L, 13) of the whole scene, world frame, the human's pelvis initially above the origin, facing x.
    controls: (T, J, 3) joint targets [rad]. strike: the step in which the foot first pushes the ball. read: what its
    file was taken for, see `Motion`.
    """

    states: np.ndarray
    controls: np.ndarray
    strike: int
    read: str = ""

    @property
    def ball_spot(self) -> np.ndarray:
        """Return the position (3,) [m] of the ball's centre before the kick."""
        return self.states[0, -1, packed.POSITION]

    def window(self, start: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return states (steps, L, 13) after each step and controls (steps, J, 3), from step `start`.

        Beyond the end, the last step repeats.
        """
        rows = np.minimum(np.arange(start, start + steps), len(self.controls) - 1)
        return self.states[rows + 1], self.controls[rows]


def standing_on_ground(
    scene: Scene, targets: np.ndarray, root: Rotation, morphology: np.ndarray | None = None
) -> np.ndarray:
    """Return states (N, L, 13) at rest, the human on the ground in the poses of joint targets (N, J, 3) [rad].

    root: N orientations of the pelvis, which is above the origin. morphology: (N, L, 3); the scene's by default.
    """
    human, count = scene.human, len(targets)
    states = np.zeros((count, len(scene.links), packed.SIZE))
    states[..., packed.ORIENTATION] = (1.0, 0.0, 0.0, 0.0)
    states[:, : len(human.links), packed.ORIENTATION] = human.pose(root.as_quat(scalar_first=True), targets)
    usual = human.sizes if morphology is None else morphology[:, : len(human.links)]
    sizes = np.broadcast_to(usual, (count, len(human.links), 3))
    closed_states = closed(scene.only(human.name), states[:, : len(human.links)], sizes)
    closed_states[..., 2] -= clearance(human, closed_states, sizes)[:, None]
    states[:, : len(human.links)] = closed_states
    return states


def clearance(body: Body, states: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the height (N,) [m] above the ground of a body's lowest link, in states (N, n, 13), sizes (N, n, 3)."""
    heights = [
        states[:, row, 2] - resting_height(link, states[:, row], sizes[:, row]) for row, link in enumerate(body.links)
    ]
    lowest: np.ndarray = np.min(heights, axis=0)
    return lowest


def resting_height(link: Link, states: np.ndarray, sizes: np.ndarray | None = None) -> np.ndarray:
    """Return the height (N,) [m] at which a link touches the ground in the orientations of states (N, 13).

    sizes: (N, 3) length, radius and mass; the link's by default.
    """
    rotations = Rotation.from_quat(states[:, packed.ORIENTATION], scalar_first=True)
    length, radius = (link.length, link.radius) if sizes is None else (sizes[:, 0], sizes[:, 1])
    height: np.ndarray = radius + 0.5 * length * np.abs(rotations.apply(link.axis)[:, 2])
    return height


def initial_states(scene: Scene, poses: Sequence[KeyPoses]) -> np.ndarray:
    """Return initial states (N, L, 13) of kicks of key poses; the ball's distance scales with the human's height."""
    human, ball = scene.human, scene.ball
    height_ratio = standing_height(human) / standing_height(bodies.human(detail=bodies.detail_of(human)))
    first = np.concatenate([pose.controls(human, 1, scene.dt) for pose in poses])
    states = standing_on_ground(scene, first, Rotation.from_euler("xy", [pose.lean for pose in poses]))
    states[:, : len(human.links), packed.VELOCITY] = np.array([pose.velocity for pose in poses])[:, None]
    states[:, -1, packed.POSITION] = [(*(height_ratio * np.array(pose.ball)), ball.links[0].radius) for pose in poses]
    return states


def embedded(scene: Scene, steps: int = 300, poses: KeyPoses | None = None) -> Reference:
    """Return the embedded kick, performed in the ground truth by the human of `scene`.

    The human is the scene's first body, the ball its last.
    """
    poses = key_poses.load() if poses is None else poses
    controls, state = poses.controls(scene.human, steps, scene.dt), initial_states(scene, [poses])[0]
    truth = Truth(scene)
    next_states, is_finite = truth.rollout(state[None], controls[None])
    if not is_finite[0]:
        raise InputError("scene: its human cannot perform the embedded reference kick; the ground truth diverged")
    states = np.concatenate([state[None], next_states[0]])
    moving = np.linalg.norm(states[:, -1, packed.VELOCITY], axis=-1) > 0.5
    if not moving.any():
        raise InputError("scene: its human misses the ball in the embedded reference kick")
    return Reference(states, controls, int(moving.argmax()) - 1)


def motion_of(path: Path, names: Mapping[str, str] | None = None) -> Motion:
    """Return the motion of a BVH file or of an npz file; see `captured`."""
    if path.suffix.lower() != ".npz":
        return bvh.load(path, names)
    if names is not None:
        raise InputError(f"names are for BVH files, but {path.name} is none: its field joints says the order")
    return angles.load(path)


def captured(
    source: str | Path | Motion,
    scene: Scene,
    seconds_before: float = 0.6,
    seconds_after: float = 1.0,
    names: Mapping[str, str] | None = None,
) -> Reference:
    """Return a captured kick, performed in the ground truth by the human of `scene`, who tracks it around its strike.

    source: a BVH file, an npz file of joint angles (see `angles.load`), or a motion. The ball is placed where the foot,
    as performed, strikes it hardest. The result is rotated and moved so that the ball leaves along the x axis (the
    human starts beside it), and mirrored if the kicking foot is the left. names: a BVH file's names of our joints, as
    in `bvh.load`; by default, those of the known skeleton that fits it. Raises an InputError where the file is not
    understood, is no kick, or no ball is hit.
    """
    for name, value in (("seconds_before", seconds_before), ("seconds_after", seconds_after)):
        if not 0.2 <= value <= 10.0:
            raise InputError(f"{name} is {value!r}, but must be from 0.2 to 10 s")
    motion = source if isinstance(source, Motion) else motion_of(Path(source), names)
    path = "the motion" if isinstance(source, Motion) else source
    if (fastest := skeleton.toe_speed(motion).max()) < skeleton.SLOWEST_KICK:
        raise InputError(f"{path} is no kick: its toes reach {fastest:.1f} m/s, but need {skeleton.SLOWEST_KICK:g} m/s")
    if skeleton.kicking_side(motion) == "Left":
        motion = skeleton.mirrored(motion)
    frame = skeleton.strike(motion)
    require_kick(path, motion, frame, scene.dt)
    clip = motion.cut(frame - round(seconds_before * motion.rate), frame + round(seconds_after * motion.rate))
    target_states, controls = _retargeted(scene, clip)
    expected_strike, last = round(skeleton.strike(clip) / clip.rate / scene.dt), len(controls) - 1
    tracker = Tracker(scene, target_states, _position_weights(scene, len(target_states), expected_strike), controls)
    states_before, targets_before = tracker.follow(target_states[0], 0, min(expected_strike + STRIKE_STEPS, last))
    ball_spot, touch_step = _ball_spot(path, scene, states_before, expected_strike)
    states_before[:, -1, packed.POSITION] = ball_spot
    states_after, targets_after = tracker.follow(states_before[touch_step], touch_step, last)
    states = np.concatenate([states_before[:touch_step], states_after])
    if not finite(states[None])[0]:
        raise InputError(f"{path}: the ground truth diverges when the human performs this kick")
    moving = np.linalg.norm(states[:, -1, packed.VELOCITY], axis=-1) > 0.5
    if not moving.any():
        raise InputError(f"{path}: the human misses the ball when it performs this kick")
    strike = int(moving.argmax()) - 1
    all_targets = np.concatenate([targets_before[:touch_step], targets_after])
    read = "; ".join(filter(None, (motion.read, _unlike_a_human(clip, scene.dt))))
    return Reference(_launched_along_x(states, strike), all_targets, strike, read)


def _unlike_a_human(clip: Motion, dt: float) -> str:
    """Return which joints bend far beyond a human's bounds, as a sentence; an empty one if none does."""
    beyond = skeleton.beyond_bounds(clip, bodies.human(), dt)
    joints = [f"{name.replace('_', ' ')} by {mean:.1f} rad" for name, mean in beyond.items() if mean > MOST_BEYOND]
    return f"joints bend beyond a human's, in the mean {', '.join(joints)}: is this its rest pose?" if joints else ""


def require_kick(path: str | Path, motion: Motion, strike: int, dt: float) -> None:
    """Raise an InputError if a motion begins too late before its strike, or its person does not stand then.

    strike: a frame of the motion. dt: the scene's time step [s].
    """
    time_before, time_needed = strike / motion.rate, (STRIKE_STEPS + 1) * dt
    if time_before < time_needed:
        raise InputError(
            f"{path} begins {time_before:.2f} s before its strike, but needs {time_needed:g} s: "
            "the foot must be fastest later"
        )
    feet = [motion.path(f"{side}Foot")[strike, 2] for side in skeleton.SIDES]
    hip_height = motion.path("Hips")[strike, 2] - min(feet)
    if hip_height < MIN_HIP_HEIGHT * motion.hip_height:
        raise InputError(
            f"{path} is no kick of one who stands: at the strike the hips are {hip_height:.2f} m above the lower foot, "
            f"but are {motion.hip_height:.2f} m in the rest pose; is the file's up axis another one?"
        )


def _launched_along_x(states: np.ndarray, strike: int) -> np.ndarray:
    """Return the states (T, L, 13), rotated about z and moved along y so that the ball leaves along the x axis."""
    x, y, _ = states[min(strike + STRIKE_STEPS, len(states) - 1), -1, packed.VELOCITY]
    rotated = turned_about_z(states, -np.arctan2(y, x))
    rotated[..., 1] -= rotated[0, -1, 1]
    return rotated


def _retargeted(scene: Scene, clip: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return the clip as states (T, L, 13) and joint targets (T, J, 3) [rad] of the human, the ball out of reach."""
    human, ball = scene.human, scene.ball
    orientations, default_targets = skeleton.retarget(clip, bodies.human(), scene.dt)
    targets = in_detail(human, default_targets)
    root = Rotation.from_quat(orientations, scalar_first=True)
    states = standing_on_ground(scene, targets, root)
    rows = scene.rows(human.name)
    height_ratio = standing_height(human) / clip.hip_height
    hip_displacement = height_ratio * (clip.path("Hips") - clip.path("Hips")[0])
    frames = len(hip_displacement)
    times, step_times = np.arange(frames) / clip.rate, skeleton.sampled_times(frames, clip.rate, scene.dt)
    for axis in (0, 1):
        states[:, rows, axis] += np.interp(step_times, times, hip_displacement[:, axis])[:, None]
    states[:, rows, packed.VELOCITY] = np.gradient(states[:, rows, packed.POSITION], scene.dt, axis=0)
    states[:, rows] = with_angular_velocities(states[:, rows], scene.dt)
    states[:, -1, packed.POSITION] = (-50.0, 0.0, ball.links[0].radius)
    return states, with_servo_lead(scene, targets)


def with_angular_velocities(states: np.ndarray, dt: float) -> np.ndarray:
    """Return the states (T, L, 13) with the angular velocities that rotate each link from one step to the next."""
    with_rates = states.copy()
    for row in range(states.shape[1]):
        rotations = Rotation.from_quat(states[:, row, packed.ORIENTATION], scalar_first=True)
        angular_velocity = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / dt
        with_rates[:, row, packed.ANGULAR_VELOCITY] = np.concatenate([angular_velocity, angular_velocity[-1:]])
    return with_rates


def with_servo_lead(scene: Scene, angles: np.ndarray) -> np.ndarray:
    """Return joint targets (T, J, 3) [rad] that lead the angles by the servos' lag, damping / stiffness."""
    lag = np.array([motor.damping / motor.stiffness for motor in scene.motors])[:, None]
    targets: np.ndarray = angles + lag * np.gradient(angles, scene.dt, axis=0)
    return targets


def _position_weights(scene: Scene, steps: int, strike: int) -> np.ndarray:
    """Return position weights (T, L) of links: higher for pelvis and feet, highest for the kicking foot at strike."""
    human = scene.human
    pelvis, left, right = (scene.index(human.name, link) for link in ("pelvis", "left_foot", "right_foot"))
    weights = np.zeros((steps, len(scene.links)))
    weights[:, scene.rows(human.name)] = 1.0
    weights[:, [pelvis, left, right]] = 5.0
    weights[max(strike - STRIKE_STEPS, 0) : strike + STRIKE_STEPS, right] = 100.0
    return weights


def _ball_spot(path: str | Path, scene: Scene, states: np.ndarray, strike: int) -> tuple[np.ndarray, int]:
    """Return the ball's position (3,) [m] just ahead of the right foot, and the step near the strike of the touch.

    It is the hardest push at a place that no other link reaches before.
    """
    human, radius = scene.human, scene.ball.links[0].radius
    foot = human.links[human.link("right_foot")]
    foot_states = states[:, scene.index(human.name, "right_foot")]
    height = foot_states[:, 2] - radius
    speed = np.linalg.norm(foot_states[:, packed.VELOCITY][:, :2], axis=-1)
    # The foot pushes along the line of centres, which its height tilts out of the horizontal.
    push_speed = speed * np.sqrt(np.maximum(1.0 - (height / (radius + foot.radius)) ** 2, 0.0))
    push_speed[abs(np.arange(len(foot_states)) - strike) > STRIKE_STEPS] = 0.0
    steps = [int(step) for step in np.argsort(-push_speed, kind="stable") if push_speed[step] > 0.0]
    if not steps:
        raise InputError(f"{path}: the foot passes {height[strike]:.2f} m above the centre of a ball, and hits none")
    spots = [_spot_ahead(foot, radius, foot_states[step]) for step in steps]
    for spot, step in zip(spots, steps, strict=True):
        if _room(scene, states[: step + 1], spot) > 0.0:
            return spot, step
    raise InputError(f"{path}: the standing leg is where the foot strikes, so that no ball can lie there")


def _spot_ahead(foot: Link, radius: float, state: np.ndarray) -> np.ndarray:
    """Return the position (3,) [m] of a ball of this radius on the ground that a foot in a state (13,) is to touch."""
    velocity, reach = state[packed.VELOCITY][:2], radius + foot.radius
    forwards = np.array([*velocity, 0.0]) / np.linalg.norm(velocity)
    rotation = Rotation.from_quat(state[packed.ORIENTATION], scalar_first=True)
    axis_points = np.linspace(-0.5, 0.5, 21)[:, None] * foot.length * rotation.apply(foot.axis)
    # Points of the foot's axis, from the ball's centre below them; moved ahead, it is out of reach of all of them.
    offsets = axis_points + np.array([0.0, 0.0, state[2] - radius])
    ahead = offsets @ forwards
    squared_aside = np.sum(offsets**2, axis=-1) - ahead**2
    distance = np.max(
        ahead + np.sqrt(np.maximum(reach**2 - squared_aside, 0.0)), where=squared_aside < reach**2, initial=0.0
    )
    return np.array([*(state[:2] + distance * forwards[:2]), radius])


def _room(scene: Scene, states: np.ndarray, spot: np.ndarray) -> float:
    """Return the least distance [m] of a ball at a place (3,) from links in states (T, L, 13), the right foot apart."""
    human, least = scene.human, np.inf
    for link in human.links:
        if link.name == "right_foot":
            continue
        own = states[:, scene.index(human.name, link.name)]
        axis = Rotation.from_quat(own[:, packed.ORIENTATION], scalar_first=True).apply(link.axis)
        offset = spot - own[:, packed.POSITION]
        along = np.clip(np.sum(offset * axis, axis=-1), -0.5 * link.length, 0.5 * link.length)
        distance = np.linalg.norm(offset - along[:, None] * axis, axis=-1) - link.radius
        least = min(least, float(distance.min()) - scene.ball.links[0].radius)
    return least
