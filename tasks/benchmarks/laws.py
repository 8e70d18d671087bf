"""Stress cases of the laws of mechanics: what free bodies keep, how they fall, and how balls bounce."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import BALL_SURFACE, ball, capsule, chain
from larp_model.engines.mujoco import Truth
from larp_model.physics.ball import SUBSTEPS
from larp_model.physics.motion import moments
from larp_model.scene import Body, Scene, Surface
from larp_model.simulator import Simulator
from tasks.benchmarks.promises import Bench, in_double, row
from tasks.benchmarks.report import Row

# Steps of free motion: 2 s.
FREE_STEPS = 200
# What trusted engines keep of energy and of momentum within that time.
ENERGY, MOMENTUM = 5e-3, 5e-4
# Rates at which bodies turn [rad/s], and the number of axes about which they do.
RATES, AXES = (1.0, 3.0, 10.0, 30.0), 16
# Height [m] at which bodies are free.
FREE = 100.0
# Restitution below which substeps of 0.5 ms are too coarse for contacts of 5 ms.
COARSE = 0.6


class Mechanics(NamedTuple):
    """Kinetic energy (*,) [J], momentum (*, 3) [kg m/s], and angular momentum (*, 3) [kg m^2/s] about the centre."""

    energy: np.ndarray
    momentum: np.ndarray
    angular_momentum: np.ndarray


def mechanics(scene: Scene, states: np.ndarray) -> Mechanics:
    """Return energy and momenta of all bodies together, in states (*, L, 13)."""
    length, radius, mass = np.array([(link.length, link.radius, link.mass) for link in scene.links]).T
    along, across = (np.asarray(part)[:, None, None] for part in moments(length, radius, mass))
    axis = np.array([link.axis for link in scene.links])
    inertia = across * np.eye(3) + (along - across) * axis[:, :, None] * axis[:, None]
    flat = states[..., packed.ORIENTATION].reshape(-1, 4)
    turned = Rotation.from_quat(flat, scalar_first=True).as_matrix().reshape(*states.shape[:-1], 3, 3)
    velocity, angular_velocity = states[..., packed.VELOCITY], states[..., packed.ANGULAR_VELOCITY]
    spin = np.einsum("...ij,...jk,...lk,...l->...i", turned, inertia, turned, angular_velocity)
    momentum = mass[:, None] * velocity
    centre = np.sum(mass[:, None] * states[..., packed.POSITION], axis=-2, keepdims=True) / mass.sum()
    orbit = np.cross(states[..., packed.POSITION] - centre, momentum)
    energy = 0.5 * np.sum(momentum * velocity + spin * angular_velocity, axis=(-2, -1))
    return Mechanics(energy, momentum.sum(axis=-2), (spin + orbit).sum(axis=-2))


def straight(body: Body) -> np.ndarray:
    """Return the state (L, 13) at rest of a ball, capsule or chain, upright in the air."""
    state = np.zeros((len(body.links), packed.SIZE))
    state[:, 3] = 1.0
    pitch = body.links[0].length + 2.0 * body.links[0].radius
    state[:, 2] = FREE - pitch * np.arange(len(body.links))
    return state


def turning(state: np.ndarray, rate: float) -> np.ndarray:
    """Return states (AXES, L, 13): of a state (L, 13), whole, turning at a rate [rad/s] about random axes."""
    axes = np.random.default_rng(0).standard_normal((AXES, 1, 3))
    spin = rate * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    states = np.repeat(state[None], AXES, axis=0)
    arms = states[..., packed.POSITION] - states[..., packed.POSITION].mean(axis=1, keepdims=True)
    states[..., packed.VELOCITY] = np.cross(spin, arms)
    states[..., packed.ANGULAR_VELOCITY] = spin
    return states


def free_bodies(bench: Bench) -> list[Row]:
    """Return rows of bodies that turn in the air without gravity: of their energy and of their momenta."""
    person = bench.kick.scene.human
    standing = bench.kick.start()[bench.kick.scene.rows(person.name)]
    standing[:, 2] += FREE
    rows: list[Row] = []
    for body, state, rates in (
        *((body, straight(body), RATES) for body in (ball(), capsule(), chain())),
        (person, standing, RATES[:-1]),
    ):
        scene = Scene((body,), gravity=0.0)
        run = jax.jit(Simulator.of_physics(scene).rollout)
        for rate in rates:
            rows += _free_rows(bench, run, scene, turning(state, rate), f"{body.name} at {rate:g} rad/s")
    return rows


def _free_rows(bench: Bench, run: jax.stages.Wrapped, scene: Scene, starts: np.ndarray, value: str) -> Iterator[Row]:
    targets = bench.kick.reference.window(0, FREE_STEPS)[1] if scene.motors else np.zeros((FREE_STEPS, 0, 3))
    controls = np.broadcast_to(targets, (len(starts), *targets.shape))
    ours = np.asarray(run(starts.astype(np.float32), controls.astype(np.float32)), float)
    engines, _ = Truth(scene, len(starts)).rollout(starts, controls)
    before = mechanics(scene, starts)
    turned = np.linalg.norm(before.angular_momentum, axis=-1)[:, None]
    pace = sum(link.mass for link in scene.links) * np.abs(starts[..., packed.ANGULAR_VELOCITY]).max()

    def errors(states: np.ndarray) -> tuple[float, ...]:
        after = mechanics(scene, states)
        pushed, turned_by = (
            np.linalg.norm(new - old[:, None], axis=-1) for new, old in zip(after[1:], before[1:], strict=True)
        )
        relative = after.energy / before.energy[:, None] - 1.0, pushed / pace, turned_by / turned
        return tuple(float(np.abs(error).max()) for error in relative)

    for name, own, engine, bound in zip(
        ("energy", "momentum", "angular momentum"), errors(ours), errors(engines), (ENERGY, MOMENTUM, MOMENTUM),
        strict=True,
    ):  # fmt: skip
        if name == "energy" and scene.motors:
            continue  # which motors change
        promise = f"LARP: {name} within {bound:g} over 2 s, or nearer than MuJoCo's at 0.5 ms"
        observation = f"{own:.1e}, MuJoCo's {engine:.1e}"
        yield row("free body", value, promise, observation, own <= bound or own <= engine)


def falls(bench: Bench) -> list[Row]:
    """Return rows of bodies that fall for a second."""
    person = bench.kick.scene.human
    standing = bench.kick.start()[bench.kick.scene.rows(person.name)]
    standing[:, 2] += FREE
    rows, steps = [], 100
    for body, state in (*((body, straight(body)) for body in (ball(), capsule(), chain())), (person, standing)):
        scene, mass = Scene((body,)), body.sizes[:, 2]
        targets = bench.kick.reference.window(0, steps)[1] if scene.motors else np.zeros((steps, 0, 3))
        ours = np.asarray(Simulator.of_physics(scene).rollout(state[None].astype(np.float32), targets[None]), float)
        engines, _ = Truth(scene, 1).rollout(state[None], targets[None])
        true = 0.5 * scene.gravity * (steps * scene.dt) ** 2
        own, engine = (
            abs(float(mass @ (state[:, 2] - states[0, -1, :, 2]) / mass.sum()) - true) for states in (ours, engines)
        )
        promise = "LARP: a fall of 1 s is g t^2 / 2, as far off as twice MuJoCo's at 0.5 ms at most"
        observation = f"off by {1e3 * own:.2g} mm, MuJoCo's by {1e3 * engine:.2g} mm"
        rows.append(row("free fall", body.name, promise, observation, own <= 2 * engine))
    return rows


def rebounds(surface: Surface, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds (64,) of balls after a bounce, as shares of the speed [m/s] before: ours, and MuJoCo's.

    They come from heights that they cover within a step.
    """
    scene, count, steps = Scene((ball(surface=surface),), gravity=0.0), 64, 20
    states = np.zeros((count, 1, packed.SIZE))
    states[..., 3] = 1.0
    states[:, 0, 2] = scene.ball.links[0].radius + speed * scene.dt * (np.arange(count) + 0.5) / count
    states[:, 0, 9] = -speed
    controls = np.zeros((count, steps, 0, 3))
    ours = Simulator.of_physics(scene).rollout(states.astype(np.float32), controls)
    engines, _ = Truth(scene, count).rollout(states, controls)
    upwards, engines_upwards = (np.asarray(after, float)[:, -1, 0, 9] / speed for after in (ours, engines))
    return upwards, engines_upwards


def bounces() -> list[Row]:
    """Return rows of balls that bounce: as their surface says, and as in MuJoCo."""
    ratio = BALL_SURFACE.damping / 2.0 / math.sqrt(BALL_SURFACE.stiffness - 0.25 * BALL_SURFACE.damping**2)
    said, rows = math.exp(-ratio * (math.pi - 2.0 * math.atan(ratio))), []
    for speed in (0.5, 2.0, 10.0, 30.0):
        ours, _ = rebounds(BALL_SURFACE, speed)
        off = float(np.abs(ours / said - 1.0).max())
        promise = f"LARP: restores {said:.3f} of its speed, as its surface says, within 1 %"
        rows.append(row("bounce", f"ball at {speed:g} m/s", promise, f"off by {100 * off:.2g} %", off <= 0.01))
    for restitution in (0.3, 0.6, 0.9, 1.0):
        for contact_time in (0.005, 0.01, 0.02):
            ours, engines = rebounds(Surface.bouncing(contact_time, restitution, 0.5), 5.0)
            off, mean = float(np.abs(ours - engines).max()), float(ours.mean())
            value = f"restitution {restitution:g} in {1e3 * contact_time:g} ms"
            rows.append(row("bounce", value, "LARP: as MuJoCo's within 0.001", f"off by {off:.1e}", off <= 1e-3))
            if restitution >= COARSE:
                share = abs(mean / restitution - 1.0)
                promise = "LARP: as the surface says within 1 %, in the mean over moments of contact"
                rows.append(row("bounce", value, promise, f"{mean:.3f}, off by {100 * share:.2g} %", share <= 0.01))
    return rows


def spinning_balls() -> list[Row]:
    """Return rows of balls that fall onto the ground with spin: they gain no energy in 2 s."""
    scene = Scene((ball(),))
    link = scene.ball.links[0]
    cases = [(speed, spin) for speed in (0.0, 5.0, 30.0) for spin in (-200.0, -100.0, 0.0, 100.0, 200.0)]
    states = np.zeros((len(cases), 1, packed.SIZE))
    states[..., 3], states[..., 2] = 1.0, link.radius + 0.5
    states[:, 0, 7], states[:, 0, 11] = np.array(cases).T
    controls = np.zeros((len(cases), FREE_STEPS, 0, 3))
    after = np.asarray(Simulator.of_physics(scene).rollout(states.astype(np.float32), controls))
    course = np.concatenate([states[:, None], after], axis=1)
    energies = mechanics(scene, course).energy + link.mass * scene.gravity * course[:, :, 0, 2]
    rows = []
    for (speed, spin), energy in zip(cases, energies, strict=True):
        gained = float((energy / energy[0]).max() - 1.0)
        value, promise = f"{speed:g} m/s, {spin:g} rad/s", "LARP: no energy gained, within 0.1 %"
        rows.append(row("ball with spin", value, promise, f"{100 * gained:+.2g} %", gained <= 1e-3))
    return rows


def bounce_slopes() -> list[Row]:
    """Return rows of derivatives of a bounce: in the mean over moments of contact, they are the slope over all of them.

    Within the substep that tells these moments apart, a bounce has another slope: see `ball.timed`.
    """
    scene, count = Scene((ball(),)), 512
    rows = []
    with jax.enable_x64(True):
        model = in_double(Simulator.of_physics(scene))
        for speed in (0.5, 1.0, 3.0, 8.0):
            states = np.zeros((count, 1, packed.SIZE))
            states[..., 3], states[:, 0, 9] = 1.0, -speed
            substeps = 4.0 * np.arange(count) / count
            states[:, 0, 2] = scene.ball.links[0].radius + 0.002 + substeps * speed * scene.dt / SUBSTEPS
            change = 0.02 * speed * np.eye(packed.SIZE)[9]
            controls = jnp.zeros((count, math.ceil(3.0 + 0.2 / speed), 0, 3))
            speeds_after = partial(_speeds_after, model, controls)
            _, slopes = jax.jvp(
                speeds_after, (jnp.asarray(states),), (jnp.broadcast_to(change, states.shape) / (0.02 * speed),)
            )
            ahead, behind = (np.asarray(speeds_after(jnp.asarray(states + side * change))) for side in (1.0, -1.0))
            own, true = float(np.mean(slopes)), float((ahead - behind).mean() / (0.04 * speed))
            promise = "LARP: the mean derivative of the speed by that before is its slope within 5 %"
            observation = f"{own:.3f}, by differences {true:.3f}"
            passed = abs(own / true - 1.0) <= 0.05
            rows.append(row("slope of a bounce", f"{speed:g} m/s", promise, observation, passed))
    return rows


def _speeds_after(model: Simulator, controls: jax.Array, states: jax.Array) -> jax.Array:
    """Return the vertical speeds (N,) [m/s] of balls after a rollout."""
    return model.rollout(states, controls)[:, -1, 0, 9]
