"""Checks of gradients: reverse, forward and central differences of a step, and growth of a kick's gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import state as packed
from larp_model.detection import first_contacts
from larp_model.learned.residual import ResidualModel
from larp_model.physics.ball import RESTING
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc import CEM, Dynamics, Gradient, evaluate
from mpc.search import coloured_noise
from tasks.benchmarks.promises import Bench, in_double, row
from tasks.benchmarks.report import Row
from tasks.episodes.around_kick import random_episodes
from tasks.exploration import exploration_std
from tasks.kick import Kick
from tasks.task import KNOTS, SEARCH

# Central differences over the largest of these [m, rad, m/s, rad/s, along a random direction of unit normal numbers];
# a state whose kink lies within it is evaluated with the next.
DIFFERENCES = (1e-7, 1e-8, 1e-9, 1e-10)
AGREE = 0.01
# Share of states in which they have to. Forces of the ground set in within 10 um, of which derivatives know nothing.
SMOOTH = 0.98
# Iterations after which all solvers of a step have converged in 64 bits.
CONVERGED = 20
# Cost per spread; a kick costs some tens, so that a true slope beyond this predicts nothing one spread away.
USEFUL = 1e3
TARGET = np.array([4.0, 0.0, 0.5])


def around_contact(bench: Bench, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states (count, L, 13) and targets (count, J, 3) [rad] of random episodes.

    The first half is near first contacts.
    """
    random = np.random.default_rng(seed)
    episodes, _ = random_episodes(bench.kick.scene, bench.kick.reference, max(count // 4, 16), seed + 3)
    contacts = first_contacts(bench.kick.scene, episodes)
    rows = random.integers(0, len(contacts), count)
    columns = random.integers(0, episodes.steps, count)
    rows[: count // 2] = random.choice(np.flatnonzero(contacts >= 0), count // 2)
    near = contacts[rows[: count // 2]] + random.integers(-2, 3, count // 2)
    columns[: count // 2] = np.clip(near, 0, episodes.steps - 1)
    states = episodes.states[rows, columns].astype(float)
    states[..., packed.ORIENTATION] /= np.linalg.norm(states[..., packed.ORIENTATION], axis=-1, keepdims=True)
    return states, episodes.controls[rows, columns].astype(float)


def step_gradients(bench: Bench, states: np.ndarray, controls: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return relative errors of one step's gradients in float64, along a random direction of state and targets each.

    reverse (N,): of the product with a random vector, against forward. differences (4, N): of the vector,
    |central - forward| / |forward|, one row per width of the difference. bounces (N,): whether the ball comes or goes
    in the step; its derivative is then that of a mean over moments, see `ball.timed`.
    """
    random = np.random.default_rng(seed)
    along = random.standard_normal(states.shape), random.standard_normal(controls.shape)
    against = random.standard_normal(states.shape)
    with jax.enable_x64(True):
        model = converged(in_double(bench.model))

        @jax.jit
        def both(place: Any, direction: Any, against: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            _, forward = jax.jvp(model.step, place, direction)
            _, pull = jax.vjp(model.step, *place)
            reverse = sum(jnp.sum(g * d, axis=(1, 2)) for g, d in zip(pull(against), direction, strict=True))
            return forward, jnp.sum(forward * against, axis=(1, 2)), jnp.asarray(reverse)

        forward, paired, reverse = (np.asarray(array) for array in both((states, controls), along, against))
        run = jax.jit(model.step)
        errors = []
        for width in DIFFERENCES:
            ahead, behind = (run(states + s * along[0], controls + s * along[1]) for s in (width, -width))
            central = (np.asarray(ahead) - np.asarray(behind)) / (2.0 * width)
            apart = np.linalg.norm((central - forward).reshape(len(states), -1), axis=1)
            errors.append(apart / np.linalg.norm(forward.reshape(len(states), -1), axis=1))
        after = np.asarray(run(states, controls))
    return {
        "reverse": np.abs(reverse - paired) / np.abs(paired),
        "differences": np.stack(errors),
        "bounces": bounces(bench.kick.scene, states, after),
    }


def converged(model: Simulator) -> Simulator:
    """Return the simulator with as many iterations of its solvers as numbers of 64 bits need."""
    assert isinstance(model.model, ResidualModel)
    constants = replace(model.model.constants, iterations=CONVERGED)
    contacts = replace(model.model.contacts, iterations=CONVERGED)
    return replace(model, model=replace(model.model, constants=constants, contacts=contacts))


def bounces(scene: Scene, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return whether (N,) the last body, a ball, moves up or down on the ground in a step between states (N, L, 13)."""
    heights = np.stack([states[:, -1, 2] - scene.ball.links[0].radius for states in (before, after)])
    speeds = np.stack([states[:, -1, 9] for states in (before, after)])
    lowest = np.minimum(heights.min(axis=0), heights[0] + scene.dt * speeds[0])
    bounced: np.ndarray = (lowest < 0.0) & (np.abs(speeds).max(axis=0) > 0.1 * RESTING)
    return bounced


def of_steps(bench: Bench, count: int, seed: int) -> list[Row]:
    """Return rows that compare reverse, forward and central differences of a step on random states."""
    states, controls = around_contact(bench, count, seed)
    comparison = step_gradients(bench, states, controls, seed)
    reverse, differences = comparison["reverse"], comparison["differences"]
    rows = [
        row(
            "gradient of a step",
            f"{count} states, float64",
            "reverse = forward within 1e-6",
            f"worst {reverse.max():.1e}",
            bool(reverse.max() <= 1e-6),
        )
    ]
    jumps = (differences[0] > AGREE) & (differences[-1] > 100.0 * differences[0])
    for name, part in (("near first contact", slice(0, count // 2)), ("elsewhere", slice(count // 2, None))):
        smooth = ~(jumps | comparison["bounces"])[part]
        best = differences[:, part].min(axis=0)[smooth]
        share = float((best <= AGREE).mean())
        observation = (
            f"median {np.median(best):.0e}, worst {best.max():.1e}, {100 * share:.1f} % within; of {len(smooth)}, "
            f"{int(jumps[part].sum())} at a jump, {int(comparison['bounces'][part].sum())} in a bounce"
        )
        promise = f"forward = central differences within {100 * AGREE:g} % in {100 * SMOOTH:g} % of states with a slope"
        rows.append(row("gradient of a step", f"{name}, float64", promise, observation, share >= SMOOTH))
    return rows


def ball_slopes(bench: Bench) -> list[Row]:
    """Return rows of a step's derivative by the ball's height, the source of the growth of gradients."""
    ball, radius = bench.kick.scene.ball.name, bench.kick.scene.ball.links[0].radius
    model = Simulator.of(bench.model.model.on(bench.kick.scene.only(ball)), bench.model.weights)
    slope = jax.jit(jax.vmap(jax.jacfwd(lambda s: model.step(s[None], jnp.zeros((1, 0, 3)))[0, 0])))
    rows = []
    for name, height, speed in (
        ("flying 1 m up", 1.0, 1.5),
        ("resting", 0.0, 0.0),
        ("rolling at 1.5 m/s", 0.0, 1.5),
        ("rolling at 10 m/s", 0.0, 10.0),
    ):
        states = np.zeros((201, 1, packed.SIZE), np.float32)
        states[:, 0, 3] = 1.0
        states[:, 0, 2] = radius + height + np.linspace(-1e-3, 1e-3, 201)
        states[:, 0, 7], states[:, 0, 11] = speed, speed / radius
        steep = np.abs(np.asarray(slope(jnp.asarray(states)))[:, 7:, 0, 2])
        promise = "LARP: 1 mm of height changes a step's speed and spin by less than 1 m/s and 1 rad/s"
        observation = f"at most {steep[:, :3].max() / 1e3:.2g} m/s, {steep[:, 3:].max() / 1e3:.2g} rad/s"
        rows.append(row("slope of a ball's step", name, promise, observation, bool(steep.max() <= 1e3)))
    return rows


def candidates(kick: Kick, count: int, seed: int) -> np.ndarray:
    """Return knots (count, K, J, 3) [rad] as the planner draws them around the reference."""
    scale = SEARCH * exploration_std(kick.scene)
    return coloured_noise(np.random.default_rng(seed), (count, KNOTS, *scale.shape), CEM.exponent) * scale


class Slope:
    """Costs of candidates of a kick and their reverse gradients, through any model of its scene; compiled once."""

    def __init__(self, kick: Kick, model: Dynamics) -> None:
        planner = kick.planner(model, (CEM(samples=4, rounds=1, elites=2),))
        window = kick.window(TARGET)(0)
        inputs = window.reference, window.context
        controls, context = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), inputs)
        start, plan = jnp.asarray(kick.start(), jnp.float32), planner.init(jax.random.key(0))
        self.scale = planner.scale

        def summed(knots: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
            targets = jax.vmap(lambda candidate: planner.controls(plan._replace(elites=candidate[None]), controls))(
                knots
            )
            states = model.rollout(jnp.broadcast_to(start, (len(knots), *start.shape)), targets, steps=steps)
            costs = jax.vmap(lambda s, u: evaluate(kick.terms, s, u, context)[0])(states, targets)
            return jnp.sum(costs), costs

        self._gradient = jax.jit(jax.value_and_grad(summed, has_aux=True))

    def __call__(self, knots: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return costs (N,) and gradients (N, K, J, 3), per spread, of knots (N, K, J, 3) [rad].

        steps: of the scene.
        """
        (_, costs), gradient = self._gradient(jnp.asarray(knots, jnp.float32), jnp.asarray(steps))
        return np.asarray(costs), np.asarray(gradient) * self.scale


def update_of(gradient: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the step (N, K, J, 3), per spread, that the planner takes down a gradient (N, K, J, 3), per spread."""
    scale = np.asarray(scale, np.float32)
    raw = np.divide(gradient, scale, where=scale > 0, out=np.zeros_like(gradient))
    moved, _, _ = Gradient().update(scale, raw, np.zeros_like(raw), 0)
    return moved / np.where(scale > 0, scale, 1.0)


def of_kicks(bench: Bench, continued_model: Dynamics, count: int, seed: int) -> list[Row]:
    """Return rows of a kick's reverse gradient in float32: its norm by the number of steps it goes back.

    The kick has 48 steps, and 120 of flight.
    """
    knots = candidates(bench.kick, count, seed)
    rows = []
    for name, model, lengths in (
        ("scene", bench.model, (8, 24, 33, bench.kick.horizon)),
        ("scene, then 120 of the ball alone", continued_model, (8, 33, bench.kick.horizon)),
    ):
        slope = Slope(bench.kick, model)
        for steps in lengths:
            costs, gradient = slope(knots, steps)
            entries = int((~np.isfinite(gradient).all(axis=(1, 2, 3)) & np.isfinite(costs)).sum())
            norms = np.linalg.norm(gradient.reshape(count, -1).astype(float), axis=1)[np.isfinite(costs)]
            norms = np.nan_to_num(norms, nan=np.inf)
            value = f"{steps} steps of the {name}"
            observation = f"{entries} of {count} not finite"
            rows.append(row("gradient of a kick", value, "every gradient finite in float32", observation, entries == 0))
            half, most, worst = np.quantile(norms, (0.5, 0.9, 1.0), method="lower")
            observation = f"median {half:.1e}, 90 % below {most:.1e}, worst {worst:.1e}"
            rows.append(
                row("gradient of a kick", value, f"norm below {USEFUL:g} per spread", observation, worst <= USEFUL)
            )
    finite = np.isfinite(gradient).all(axis=(1, 2, 3))
    for name, factor in (("as it is", 1.0), ("times 1e20", np.float32(1e20))):
        enlarged = gradient[finite] * factor
        enlarged = enlarged[np.isfinite(enlarged).all(axis=(1, 2, 3))]
        moved = np.linalg.norm(update_of(enlarged, slope.scale).reshape(len(enlarged), -1), axis=1)
        stuck = int((moved == 0.0).sum())
        whole_steps = bool(np.isfinite(moved).all() and stuck == 0)
        observation = f"{stuck} of {len(moved)} stand still, longest step {moved.max():.2g} spreads"
        rows.append(
            row("step down a kick's gradient", name, "every candidate takes a finite step", observation, whole_steps)
        )
    return rows
