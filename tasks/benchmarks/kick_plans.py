"""Stress cases of plans of kicks: targets that no ball reaches, random tasks, and plans that are made again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.errors import InputError
from mpc import CEM, Dynamics, GaussNewton, Planner
from tasks.benchmarks.promises import Bench, row
from tasks.benchmarks.report import Row
from tasks.command import prepare_jax
from tasks.kick import USUAL, Kick
from tasks.models import models_of
from tasks.presets import PRESETS
from tasks.run import REACHABLE

StateAndTarget = tuple[np.ndarray, np.ndarray]
"""State (L, 13) and target (3,) [m] of a kick, of which numbers may be anything."""


def targets(bench: Bench, continued_model: Dynamics) -> list[Row]:
    """Return rows of kick plans to targets, most of which no ball can reach."""
    kick = bench.kick
    planner = kick.planner(continued_model, (CEM(samples=16, rounds=2, elites=4),))
    plan = planner.init(jax.random.key(0))
    rows = []
    ball = kick.start()[-1, :3]
    for name, target, reachable in (
        ("ahead", (4.0, 0.0, 0.5), None),
        ("behind the human", (-4.0, 0.0, 0.5), False),
        ("inside the human", tuple(kick.start()[0, :3]), False),
        ("the ball's own place", tuple(ball), True),
        ("below the ground", (4.0, 0.0, -2.0), False),
        ("1 km away", (1e3, 0.0, 0.0), False),
        ("1e6 m away", (1e6, 0.0, 0.0), False),
        ("1e19 m away", (1e19, 0.0, 0.0), False),
        ("1e30 m away", (1e30, 0.0, 0.0), False),
    ):
        window = kick.window(np.array(target))(0)
        after, info = planner.step(plan, kick.start(), window)
        with np.errstate(all="ignore"):
            miss = kick.missed(info.states, 1, np.array(target)) if np.isfinite(target).all() else np.inf
        whole_plan = bool(np.isfinite(after.knots).all())
        honest = np.isfinite(info.cost) == (info.finite > 0)
        right = reachable is None or (miss <= REACHABLE) == reachable
        promise = "a finite plan, cost inf if no candidate is finite"
        promise += "" if reachable is None else f", {'' if reachable else 'not '}within {REACHABLE:g} m of it"
        observation = f"misses by {miss:.3g} m, cost {info.cost:.3g}, {info.finite} of {info.candidates} finite"
        rows.append(row("target", name, promise, observation, whole_plan and honest and right))
    return rows


def _ahead(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    bearing, distance = random.uniform(-0.6, 0.6), random.uniform(1.0, 6.0)
    return kick.start(), np.array([distance * np.cos(bearing), distance * np.sin(bearing), random.uniform(0.0, 1.5)])


def _anywhere(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    return kick.start(), random.uniform((-10.0, -10.0, -1.0), (10.0, 10.0, 5.0))


def _far(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    direction = random.standard_normal(3)
    return kick.start(), 10.0 ** random.uniform(1.0, 30.0) * direction / np.linalg.norm(direction)


def _inside(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    start = kick.start()
    return start, start[random.integers(len(start)), packed.POSITION] + random.uniform(-0.1, 0.1, 3)


def _ball_elsewhere(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    return kick.start(random.uniform(-2.0, 2.0, 2)), USUAL


def _ball_rolling(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    return kick.start(random.uniform(-0.2, 0.2, 2), random.uniform(-10.0, 10.0, 2)), USUAL


def _ball_flying(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    start = kick.start(random.uniform(-2.0, 2.0, 2))
    start[-1, 2] += random.uniform(0.0, 3.0)
    start[-1, packed.VELOCITY] = random.uniform(-30.0, 30.0, 3)
    start[-1, packed.ANGULAR_VELOCITY] = random.uniform(-200.0, 200.0, 3)
    return start, USUAL


def _human_pushed(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    start = kick.start()
    start[kick.human, packed.VELOCITY] += random.uniform(-5.0, 5.0, 3)
    return start, USUAL


def _human_turned(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    start, rows = kick.start(), kick.human
    turn = Rotation.random(rng=random)
    own = Rotation.from_quat(start[rows, packed.ORIENTATION], scalar_first=True)
    start[rows, packed.ORIENTATION] = (turn * own).as_quat(scalar_first=True)
    pelvis = start[0, packed.POSITION].copy()
    start[rows, packed.POSITION] = pelvis + turn.apply(start[rows, packed.POSITION] - pelvis)
    return start, USUAL


def _no_numbers(random: np.random.Generator, kick: Kick) -> StateAndTarget:
    start, target = kick.start(), USUAL.copy()
    broken = random.choice([np.nan, np.inf, -np.inf, 1e39])
    if random.random() < 0.5:
        target[random.integers(3)] = broken
    else:
        start[random.integers(len(start)), random.integers(packed.SIZE)] = broken
    return start, target


# Random tasks, by kind.
KINDS: dict[str, Callable[[np.random.Generator, Kick], StateAndTarget]] = {
    "target ahead": _ahead,
    "target anywhere": _anywhere,
    "target at 10 to 1e30 m": _far,
    "target in the human": _inside,
    "ball elsewhere": _ball_elsewhere,
    "ball that rolls": _ball_rolling,
    "ball that flies": _ball_flying,
    "human who is pushed": _human_pushed,
    "human upside down": _human_turned,
    "no numbers": _no_numbers,
}


def random_kicks(bench: Bench, continued_model: Dynamics, kind: str, count: int, seed: int) -> list[Row]:
    """Return the row of plans of `fast` for random tasks of a kind: a finite plan, or one line that says why not."""
    kick, random = bench.kick, np.random.default_rng((seed, [*KINDS].index(kind)))
    planner = kick.planner(continued_model, PRESETS["fast"].first)
    plan = planner.init(jax.random.key(seed))
    refused, faults, slowest = 0, list[str](), 0.0
    for _ in range(count):
        state, target = KINDS[kind](random, kick)
        begin = time.monotonic()
        try:
            with np.errstate(over="ignore"):
                after, info = planner.step(plan, kick.check_state(state), kick.window(kick.check(target))(0))
            if not (np.isfinite(after.knots).all() and np.isfinite(info.cost) == (info.finite > 0)):
                faults.append("a plan that is not finite")
        except InputError as error:
            refused += 1
            if "\n" in str(error):
                faults.append(f"several lines: {error}")
        except Exception as error:
            faults.append(f"{type(error).__name__}: {error}")
        slowest = max(slowest, time.monotonic() - begin)
    observation = (
        f"{count - refused - len(faults)} plans, {refused} refused, {len(faults)} neither; slowest {slowest:.1f} s"
    )
    observation += f"; the first: {faults[0][:80]}" if faults else ""
    return [row("random kicks", f"{kind}, {count}", "a finite plan, or one line", observation, not faults)]


def knots_of_a_plan() -> np.ndarray:
    """Return the knots (K, J, 3) [rad] of a plan of the usual kick, by sampling and steps."""
    prepare_jax()
    kick = Kick.standard()
    planner: Planner = kick.planner(models_of(kick.scene, "larp").scene, (CEM(32, 2, 8), GaussNewton(rounds=2)))
    plan, _ = planner.step(planner.init(jax.random.key(3)), kick.start(), kick.window(USUAL)(0))
    return np.asarray(plan.knots)


IN_A_PROCESS = """
import os, sys
if sys.argv[1] == "1" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from tasks.benchmarks.kick_plans import knots_of_a_plan
sys.stdout.buffer.write(knots_of_a_plan().tobytes())
"""


def repeated_plans() -> list[Row]:
    """Return rows of the same plan made again: in this process, in another one, and with one thread."""
    knots = knots_of_a_plan()

    def in_a_process(threads: str) -> np.ndarray:
        command = [sys.executable, "-c", IN_A_PROCESS, threads]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        output = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment).stdout
        return np.frombuffer(output, knots.dtype).reshape(knots.shape)

    rows = []
    for value, promise, again, most in (
        ("in one process", "the same plan, bit for bit", knots_of_a_plan(), 0.0),
        ("in two processes", "the same plan, bit for bit", in_a_process("all"), 0.0),
        ("with one thread", "the same plan within 0.001 rad", in_a_process("1"), 1e-3),
    ):
        apart = float(np.abs(again - knots).max())
        rows.append(row("plan made again", value, promise, f"{apart:.1e} rad apart", apart <= most))
    return rows
