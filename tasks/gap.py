"""Differences between a kick as the model predicted it and as it happened: contact, launch, landing, joints."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.detection import contact_points
from larp_model.physics.kinematics import morphology_of
from larp_model.scene import Scene
from tasks.strike import strike_step

# The ball's launch is read so many steps after the strike.
LAUNCH_STEPS = 8
# It flies when it is higher above the ground than this, and has landed when it is lower than that [m].
FLYING, LANDED = 0.02, 0.005


def events(scene: Scene, states: np.ndarray, free: np.ndarray) -> dict[str, Any]:
    """Return the ball's contact, launch and landing in states (T, L, 13); None for each that does not happen.

    contact_s: when the ball has been struck, to a step. contact_link: by which link. contact_point_m: where, from the
    ball's centre (3,). launch_m_s: its velocity (3,) `LAUNCH_STEPS` later. landing_m: where it first comes down (2,).
    free: (T, 13), states of the untouched ball, see `strike`.
    """
    none = dict.fromkeys(("contact_s", "contact_link", "contact_point_m", "launch_m_s", "landing_m"))
    contact = strike_step(states, free)
    if not contact:
        return none
    ball = states[:, -1]
    radius = scene.ball.links[0].radius
    nearest, normal = _nearest(scene, states[contact - 1])
    launch = ball[min(contact + LAUNCH_STEPS, len(ball) - 1), packed.VELOCITY]
    height = ball[contact:, 2] - radius
    flying = height > FLYING
    down = np.flatnonzero((height < LANDED) & (np.cumsum(flying) > 0))
    return none | {
        "contact_s": contact * scene.dt,
        "contact_link": nearest,
        "contact_point_m": _list(-radius * normal),
        "launch_m_s": _list(launch),
        "landing_m": _list(ball[contact + down[0], :2]) if len(down) else None,
    }


def gap(scene: Scene, truth: np.ndarray, model: np.ndarray, start: int, free: np.ndarray) -> dict[str, Any]:
    """Return every event in the ground truth and in the model, and how far apart the two are.

    truth: states (T, L, 13). model: predicted states (T', L, 13), the first of them the ground truth's in row `start`.
    free: (T, 13), states of the untouched ball.
    launch_error: |v - v'| / |v|; launch_angle_deg: between the two; links_m, joints_deg: mean distance of the human's
    links and mean angle between its joints, at the true contact.
    """
    true = events(scene, truth, free)
    expected = events(scene, model, free[start:])
    if expected["contact_s"] is not None:
        expected["contact_s"] += start * scene.dt
    result: dict[str, Any] = {name: {"truth": true[name], "model": expected[name]} for name in true}
    result |= dict.fromkeys(("launch_error", "launch_angle_deg", "links_m", "joints_deg"))
    if true["launch_m_s"] and expected["launch_m_s"]:
        a, b = np.array(true["launch_m_s"]), np.array(expected["launch_m_s"])
        speed = np.linalg.norm(a)
        cosine = a @ b / max(speed * np.linalg.norm(b), 1e-9)
        result["launch_error"] = float(np.linalg.norm(a - b) / speed)
        result["launch_angle_deg"] = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    contact = strike_step(truth, free)
    if contact is not None and 0 <= contact - start < len(model):
        human = scene.rows(scene.human.name)
        a, b = truth[contact, human], model[contact - start, human]
        result["links_m"] = float(np.linalg.norm(a[:, :3] - b[:, :3], axis=-1).mean())
        turned = joint_rotations(scene, a).inv() * joint_rotations(scene, b)
        result["joints_deg"] = float(np.degrees(turned.magnitude()).mean())
    return result


def described(gap: dict[str, Any]) -> dict[str, str]:
    """Return the gap as labelled lines of a few words, for display."""
    lines = {}
    if (contact := gap["contact_s"])["truth"] is not None:
        lines["contact"] = (
            "{truth:.2f} s (model {model:.2f} s)".format(**contact) if contact["model"] else "not expected"
        )
    if gap["launch_error"] is not None:
        speeds = {side: float(np.linalg.norm(velocity)) for side, velocity in gap["launch_m_s"].items()}
        apart = f"{gap['launch_angle_deg']:.1f}\N{DEGREE SIGN} apart"
        lines["launch"] = "{truth:.1f} m/s (model {model:.1f} m/s, ".format(**speeds) + apart + ")"
    if all(gap["landing_m"].values()):
        ways = {side: float(np.hypot(*place)) for side, place in gap["landing_m"].items()}
        lines["lands at"] = "{truth:.1f} m (model {model:.1f} m)".format(**ways)
    if gap["links_m"] is not None:
        lines["body at contact"] = f"{1000.0 * gap['links_m']:.1f} mm, {gap['joints_deg']:.1f}\N{DEGREE SIGN} off"
    return lines


def joint_rotations(scene: Scene, state: np.ndarray) -> Rotation:
    """Return the rotation of each child link of the first body in its parent's frame, from the body's state (n, 13)."""
    turned = Rotation.from_quat(state[:, packed.ORIENTATION], scalar_first=True)
    joints = scene.human.joints
    parents = [joint.parent for joint in joints]
    return turned[parents].inv() * turned[1 : len(joints) + 1]


def _nearest(scene: Scene, state: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the human's link that touches the ball first after a state (L, 13), and the contact normal (3,)."""
    [pair] = scene.between.pairs
    gaps, normals = _approached(scene.between, jnp.asarray(state))
    nearest = int(np.argmin(gaps))
    return pair.first_links[nearest // len(pair.second_links)], np.asarray(normals[nearest])


@partial(jax.jit, static_argnums=0)
def _approached(scene: Scene, state: Array) -> tuple[Array, Array]:
    [(_, points)] = contact_points(scene, state[None], morphology_of(scene)[None])
    return points.gap[0] - points.near[0], points.normal[0]


def _list(values: np.ndarray) -> list[float]:
    return [float(value) for value in values]
