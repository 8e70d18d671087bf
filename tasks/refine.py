"""Refinement of the key poses of the embedded kick in the ground truth, by CMA-ES.

CMA-ES: N. Hansen and A. Ostermeier, Evolutionary Computation 9 (2001); with a diagonal covariance at first: R. Ros and
N. Hansen, PPSN 2008.

    minimise over x   mean_k [ strike(S^k) + stand(S^k) ] + w |x - x^authored|^2
    subject to        S^k_{t+1} = truth(S^k_t, Q_t + noise^k_t),  S^k_0 and Q from the key poses x

Kick k = 0 is undisturbed; the others have their ball moved and smooth noise on their joint targets until the strike,
as a planner would add, so that the human learns to stay up whatever the kick.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from larp_model import state as packed
from larp_model.bodies import human_and_ball, standing_height
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.files import write_whole
from larp_model.scene import Scene
from tasks.command import run
from tasks.exploration import exploration_std, smooth_noise
from tasks.motions import key_poses
from tasks.motions.key_poses import KeyPoses
from tasks.motions.references import initial_states
from tasks.targets import SHIFT

# Aims of a kick: launch and toe speed [m/s], elevation of the launch [rad], earliest and latest step of the
# strike, clearance of the toes before it [m], and how long it is watched [steps].
LAUNCH, TOE, ELEVATION, STRIKE, CLEARANCE, WATCHED = (11.0, 14.0), (9.5, 14.0), 0.2, (32, 42), 0.015, 300
# Spreads of the search: by joint angle [rad], lean [rad], velocity [m/s], ball's place [m].
ANGLE, LEAN, VELOCITY, PLACE = 0.15, 0.03, 0.15, 0.03


def numbers(poses: KeyPoses) -> np.ndarray:
    """Return the search variables (D,) in units of their spreads; the angles first, by joint, axis and time."""
    angles = np.array(list(poses.angles.values())).ravel() / ANGLE
    return np.concatenate(
        [angles, np.divide(poses.lean, LEAN), np.divide(poses.velocity[:2], VELOCITY), np.divide(poses.ball, PLACE)]
    )


def with_numbers(poses: KeyPoses, x: np.ndarray) -> KeyPoses:
    """Return key poses with the search variables x, see `numbers`, rounded to the digits of their file."""
    angles = np.round(ANGLE * x[:-6].reshape(len(poses.angles), len(poses.times)), 3)
    return dataclasses.replace(
        poses,
        angles={joint: tuple(row.tolist()) for joint, row in zip(poses.angles, angles, strict=True)},
        lean=tuple(np.round(LEAN * x[-6:-4], 3).tolist()),
        velocity=(*np.round(VELOCITY * x[-4:-2], 3).tolist(), 0.0),
        ball=tuple(np.round(PLACE * x[-2:], 3).tolist()),
    )


def outside(value: np.ndarray, lower: float, upper: float) -> np.ndarray:
    """Return how far values are outside an interval; 0 inside."""
    return np.maximum(lower - value, 0.0) + np.maximum(value - upper, 0.0)


def costs(scene: Scene, states: np.ndarray) -> dict[str, np.ndarray]:
    """Return the named costs (N,) of kicks (N, T + 1, L, 13)."""
    human, count = scene.human, np.arange(len(states))
    foot = human.links[human.link("right_foot")]
    right, left = (states[:, :, human.link(f"{side}_foot")] for side in ("right", "left"))
    pelvis, ball = states[:, :, 0], states[:, :, -1]
    hit = np.linalg.norm(ball[..., packed.VELOCITY], axis=-1) > 0.5
    touched = hit.any(axis=1)
    strike = np.where(touched, hit.argmax(axis=1) - 1, STRIKE[1])

    launch = ball[count, strike + 6, packed.VELOCITY]
    speed = np.linalg.norm(launch, axis=-1)
    azimuth, elevation = np.arctan2(launch[:, 1], launch[:, 0]), np.arctan2(launch[:, 2], np.hypot(*launch[:, :2].T))
    toe_arm = (0.5 * foot.length + foot.radius) * _axis(right[..., packed.ORIENTATION], 0)
    toe = np.linalg.norm(right[..., packed.VELOCITY] + np.cross(right[..., packed.ANGULAR_VELOCITY], toe_arm), axis=-1)
    lowest = right[..., 2] - 0.5 * foot.length * abs(toe_arm[..., 2]) / (0.5 * foot.length + foot.radius) - foot.radius
    steps = np.arange(states.shape[1])
    swinging = (steps > 4) & (steps < strike[:, None])
    apart = np.linalg.norm(right[..., :3] - ball[..., :3], axis=-1).min(axis=1)

    standing = standing_height(human)
    sunk = np.maximum(0.88 - pelvis[..., 2] / standing, 0.0)
    trunk = states[:, :, [0, human.link("torso")]]
    tilted = np.maximum(0.93 - _axis(trunk[..., packed.ORIENTATION], 2)[..., 2], 0.0).sum(axis=-1)
    mass = np.array([link.mass for link in human.links])
    body = states[:, :, : len(human.links)]
    centre = np.average(body[..., packed.POSITION], axis=2, weights=mass)
    moving = np.average(body[..., packed.VELOCITY], axis=2, weights=mass)
    # Extrapolated centre of mass (A. Hof et al., J. Biomechanics 38 (2005)), from the middle of the feet.
    beyond = (centre + moving * np.sqrt(standing / scene.gravity) - 0.5 * (left + right)[..., :3])[..., :2]
    landed = steps > strike[:, None] + 50
    off = np.linalg.norm(beyond / (0.25, 0.15), axis=-1)
    late = steps >= states.shape[1] - 60
    restless = np.square(body[:, late][..., packed.VELOCITY]).mean(axis=(1, 2, 3))
    lifted = np.maximum(right[:, late, 2] - foot.radius, 0.0) + np.maximum(left[:, late, 2] - foot.radius, 0.0)
    launched = 0.5 * outside(speed, *LAUNCH) + 100.0 * azimuth**2 + 100.0 * (elevation - ELEVATION) ** 2
    return {
        "missed": np.where(touched, 0.0, 20.0 + 5.0 * apart),
        "launch": np.where(touched, np.minimum(launched, 10.0), 10.0),
        "toe": 2.0 * outside(toe[count, strike], *TOE),
        "timing": 0.5 * outside(strike, *STRIKE),
        "scuffed": 100.0 * (np.maximum(CLEARANCE - lowest, 0.0) * swinging).sum(axis=1),
        "sunk": 30.0 * sunk.mean(axis=1),
        "tilted": 10.0 * tilted.mean(axis=1),
        "balance": 2.0 * (np.minimum(off, 4.0) * landed).mean(axis=1),
        "restless": 2.0 * np.minimum(restless, 4.0),
        "lifted": 5.0 * lifted.mean(axis=1),
        "fell": 3.0 * (pelvis[..., 2] < 0.5 * standing).mean(axis=1),
    }


def _axis(orientation: np.ndarray, axis: int) -> np.ndarray:
    """Return column `axis` (*, 3) of the rotation matrices of quaternions (*, 4)."""
    w, x, y, z = np.moveaxis(orientation, -1, 0)
    columns = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack(columns[axis], axis=-1)


def disturbances(random: np.random.Generator, scene: Scene, kicks: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts of the ball (kicks, 2) [m] and noise on joint targets (kicks, WATCHED, J, 3) [rad].

    The first kick has neither. size: factor of both.
    """
    shift = size * random.uniform(-SHIFT, SHIFT, (kicks, 2))
    noise = np.zeros((kicks, WATCHED, len(scene.motors), 3))
    noise[:, : STRIKE[1]] = smooth_noise(random, kicks, STRIKE[1], 7, 0.5 * size * exploration_std(scene))
    shift[0], noise[0] = 0.0, 0.0
    return shift, noise


def perform(
    scene: Scene, truth: Truth, poses: list[KeyPoses], shift: np.ndarray, noise: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the named costs (N, K) of N key poses, each executed under K disturbances."""
    kicks = len(shift)
    states = np.repeat(initial_states(scene, poses), kicks, axis=0)
    states[:, -1, :2] += np.tile(shift, (len(poses), 1))
    controls = np.stack([key_pose.controls(scene.human, WATCHED, scene.dt) for key_pose in poses])
    after, finite = truth.rollout(states, (controls[:, None] + noise).reshape(-1, *controls.shape[1:]))
    after[~finite] = states[~finite, None]  # counts as a kick that never happened
    named = costs(scene, np.concatenate([states[:, None], after], axis=1))
    named["missed"][~finite] += 100.0
    return {name: cost.reshape(len(poses), kicks) for name, cost in named.items()}


def main(
    out: Path = key_poses.FILE,
    rounds: int = 300,
    population: int = 40,
    kicks: int = 3,
    size: float = 0.5,
    spread: float = 0.5,
    substeps: int = 8,
    seed: int = 0,
) -> None:
    """Refine the key poses; the best so far are in the file after every tenth round and the last.

    Args:
        out: file of the refined key poses.
        rounds: of the search.
        population: key poses evaluated in a round.
        kicks: of each, all but the first of them disturbed.
        size: of the disturbances; 1 moves the ball as far as the benchmark does.
        spread: of the search at first.
        substeps: engine steps in a control step.
        seed: of the search.
    """
    for name, value, least in (("rounds", rounds, 1), ("population", population, 4), ("kicks", kicks, 1)):
        if value < least:
            raise InputError(f"{name} is {value}, but must be at least {least}")
    try:
        import cma
    except ModuleNotFoundError:
        raise InputError("cma is not installed: pip install 'larp-mpc[refine]'") from None
    console, scene, random = Console(), human_and_ball(), np.random.default_rng(seed)
    authored = key_poses.load()
    mean = numbers(authored)
    truth = Truth(scene, population * kicks, substeps)
    search = cma.CMAEvolutionStrategy(
        mean,
        spread,
        {"popsize": population, "seed": seed + 1, "verbose": -9, "CMA_diagonal": 150, "maxiter": rounds},
    )
    for round_ in range(rounds):
        begin = time.perf_counter()
        candidates = search.ask()
        poses = [with_numbers(authored, np.asarray(x)) for x in candidates]
        named = perform(scene, truth, poses, *disturbances(random, scene, kicks, size))
        total = sum(cost.mean(axis=1) for cost in named.values())
        search.tell(candidates, (total + 0.02 * np.mean((np.array(candidates) - mean) ** 2, axis=1)).tolist())
        if round_ % 10 == 9 or round_ + 1 == rounds:
            # Under disturbances the luckiest candidate is not the best one.
            chosen = search.result.xbest if kicks == 1 else search.mean
            write_whole(out, key_poses.dumps(with_numbers(authored, np.asarray(chosen))).encode())
            best = int(np.argmin(total))
            shown = ", ".join(f"{name} {cost[best].mean():.2f}" for name, cost in named.items())
            fell = (named["fell"] > 0.0).mean()
            console.print(
                f"{round_ + 1}: {np.median(total):.2f}, best {total[best]:.2f} ({shown}), {100 * fell:.0f} % fell, "
                f"spread {search.sigma:.3f}, {time.perf_counter() - begin:.1f} s"
            )


if __name__ == "__main__":
    run(main)
