"""Training, resumed after an interruption: residual networks on single steps, others by the paper's Algorithm 1."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
from jax import Array
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from larp_model import losses, rotation
from larp_model.detection import first_contacts
from larp_model.errors import InputError
from larp_model.learned.model import Model, initial_weights
from larp_model.learned.residual import ResidualModel
from larp_model.losses import LossWeights
from larp_model.networks import Weights
from larp_model.scene import Scene
from larp_model.simulator import rollout
from larp_model.state import Trajectories
from larp_model.step_examples import StepExamples, step_loss, table_of

# Updates whose time tells how many fit into the time of a training.
TIMED = 20
# File of a run's folder with a row every hundred updates.
HISTORY = "history.jsonl"


@dataclass(frozen=True)
class Recipe:
    """Settings of a training run.

    curriculum: (unroll in steps, share of the updates) in order. learning_rate falls to `final` of itself by a cosine.
    clip: largest gradient norm. drop: norm beyond which a batch is dropped. contact_share: windows that start from
    `before_contact` steps before the first contact of two bodies on. turned: turn windows at random about z, for models
    that are not invariant. emphasis: weight of each body's links in the loss.
    """

    updates: int = 20000
    batch: int = 256
    curriculum: tuple[tuple[int, float], ...] = ((2, 0.1), (4, 0.1), (8, 0.15), (14, 0.15), (20, 0.5))
    learning_rate: float = 1e-3
    final: float = 0.01
    clip: float = 0.3
    drop: float = 30.0
    contact_share: float = 0.7
    before_contact: int = 10
    turned: bool = True
    emphasis: tuple[tuple[str, float], ...] = (("ball", 3.0), ("capsule", 3.0))
    loss: LossWeights = field(default_factory=LossWeights)
    stop_gradient: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("updates", "batch"):
            if getattr(self, name) < 1:
                raise InputError(f"recipe.{name} is {getattr(self, name)!r}, but must be at least 1")
        if abs(sum(share for _, share in self.curriculum) - 1.0) > 1e-6:
            raise InputError(f"recipe.curriculum is {self.curriculum!r}, but its shares must sum to 1")

    def unroll(self, update: int) -> int:
        """Return the number of steps unrolled at an update."""
        done = 0.0
        for steps, share in self.curriculum:
            done += share * self.updates
            if update < done:
                return steps
        return self.curriculum[-1][0]


class TrainingState(NamedTuple):
    """State of training in a checkpoint: networks, the optimiser's state, and number of updates done."""

    networks: dict[str, Any]
    optimiser: Any
    update: int


class Batch(NamedTuple):
    """B windows of so many steps: states (B, steps + 1, L, 13), the rest as in episodes."""

    states: np.ndarray
    controls: np.ndarray
    torques: np.ndarray
    morphology: np.ndarray


class Windows:
    """Training windows, drawn from sources of trajectories by their shares."""

    def __init__(self, scene: Scene, sources: Sequence[tuple[Trajectories, float]], recipe: Recipe) -> None:
        self.sources, self.recipe = [source for source, _ in sources], recipe
        share = np.array([share for _, share in sources], float)
        self.share = share / share.sum()
        self.contacts = [first_contacts(scene.between, source) for source in self.sources]

    def rows(self, random: np.random.Generator, steps: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the windows of so many steps that a batch takes from each source: episodes and first steps (n,)."""
        counts = random.multinomial(self.recipe.batch, self.share)
        rows = []
        for source, contacts, count in zip(self.sources, self.contacts, counts, strict=True):
            last = source.controls.shape[1] - steps
            # A contact so late that its windows would have to start more than `before_contact` earlier is left out.
            struck = np.flatnonzero((contacts >= 0) & (contacts - self.recipe.before_contact <= last))
            near_contact = min(round(self.recipe.contact_share * count), count if len(struck) else 0)
            anywhere = random.integers(len(contacts), size=count - near_contact)
            episodes = np.concatenate(
                [struck[random.integers(len(struck), size=near_contact)] if near_contact else struck[:0], anywhere]
            )
            if last < 0:
                raise InputError(f"episodes have {source.controls.shape[1]} steps, but the unroll needs {steps}")
            start = random.integers(last + 1, size=count)
            back = random.integers(self.recipe.before_contact + 1, size=near_contact)
            start[:near_contact] = np.clip(contacts[episodes[:near_contact]] - back, 0, last)
            rows.append((episodes, start))
        return rows

    def draw(self, random: np.random.Generator, steps: int) -> Batch:
        """Return windows of so many steps."""
        parts = []
        for source, (episodes, start) in zip(self.sources, self.rows(random, steps), strict=True):
            columns, rows = start[:, None] + np.arange(steps + 1), episodes[:, None]
            parts.append(
                (
                    source.states[rows, columns],
                    source.controls[rows, columns[:, :-1]],
                    source.torques[rows, columns[:, :-1]],
                    source.morphology[episodes],
                )
            )
        return Batch(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def draw_examples(self, table: StepExamples, random: np.random.Generator, steps: int) -> StepExamples:
        """Return the first steps of the windows that `draw` returns, from the table of all steps of the sources."""
        rows, begin = list[np.ndarray](), 0
        for source, (episodes, start) in zip(self.sources, self.rows(random, steps), strict=True):
            count, length = source.controls.shape[:2]
            rows.append(begin + episodes * length + start)
            begin += count * length
        numbers = np.concatenate(rows)
        drawn: StepExamples = jax.tree.map(lambda values: values[numbers], table)
        return drawn


def statistics_of(model: Model, windows: Windows, random: np.random.Generator, batches: int = 32) -> Weights:
    """Return initial weights, with statistics of single steps of the ground truth, drawn as in training."""
    windows_of_steps = [windows.draw(random, 2) for _ in range(batches)]
    states, controls, torques, morphology = (np.concatenate(column) for column in zip(*windows_of_steps, strict=True))
    turns = rotation.random_turns(jax.random.key(int(random.integers(2**31))), len(states))
    if windows.recipe.turned and not model.invariant:
        states = np.asarray(rotation.turn_states(jnp.asarray(states), turns[:, None]))
    step = states[:, 0], states[:, 1], controls[:, 0], torques[:, 0], morphology
    statistics = jax.jit(model.measure)(*step)
    return initial_weights(model, jax.random.key(int(random.integers(2**31))), statistics)


def emphasis(scene: Scene, recipe: Recipe) -> Array:
    """Return the weight (L,) of each link in the loss."""
    factors = dict(recipe.emphasis)
    return jnp.array([factors.get(body.name, 1.0) for body in scene.bodies for _ in body.links], jnp.float32)


def optimiser(recipe: Recipe) -> optax.GradientTransformation:
    """Return Adam behind a clipped gradient norm; its changes have to be multiplied by a learning rate."""
    return optax.chain(optax.clip_by_global_norm(recipe.clip), optax.scale_by_adam())


def learning_rate(recipe: Recipe, update: int) -> float:
    """Return the learning rate of an update: it rises for a while, then falls on a cosine."""
    warm = min(500, recipe.updates // 10 + 1)
    if update < warm:
        return recipe.learning_rate * update / warm
    done = min(1.0, (update - warm) / max(recipe.updates - warm, 1))
    return recipe.learning_rate * (recipe.final + (1.0 - recipe.final) * 0.5 * (1.0 + math.cos(math.pi * done)))


Update = Callable[[dict[str, Any], Any, Array, Any, float | Array], tuple[dict[str, Any], Any, dict[str, Array]]]
"""(networks, the optimiser's state, key, batch, learning rate) -> (networks, state, losses and norms by name).

A batch is a `Batch`; of residual networks, which learn from single steps, it is `StepExamples`.
"""


def update_of(model: Model, recipe: Recipe, weights: Weights) -> Update:
    """Return one step of gradient descent as a pure function; see `Update`.

    Only the statistics of `weights` are used. A batch whose gradient is not finite or beyond `recipe.drop` is dropped.
    """
    scene, transform = model.scene, optimiser(recipe)
    link_weights = emphasis(scene, recipe)

    def loss_of(networks: dict[str, Any], batch: Any) -> tuple[Array, dict[str, Array]]:
        all_weights = weights._replace(networks=networks)
        if isinstance(model, ResidualModel):
            return step_loss(model, all_weights, batch)
        states = batch.states
        predicted = rollout(
            model, all_weights, states[:, 0], batch.controls, batch.torques, batch.morphology,
            stop_gradient=recipe.stop_gradient,
        )  # fmt: skip
        return losses.total(scene, recipe.loss, link_weights, predicted, states[:, 1:], batch.morphology)

    def update(
        networks: dict[str, Any], state: Any, key: Array, batch: Any, rate: float | Array
    ) -> tuple[dict[str, Any], Any, dict[str, Array]]:
        if recipe.turned and not model.invariant:
            turn = rotation.random_turns(key, len(batch.states))
            states = rotation.turn_states(batch.states, turn[:, None])
            batch = batch._replace(states=states, torques=rotation.about_z(batch.torques, turn[:, None, None]))
        (loss, terms), gradient = jax.value_and_grad(loss_of, has_aux=True)(networks, batch)
        norm = optax.tree.norm(gradient)
        accepted = jnp.isfinite(norm) & (norm < recipe.drop)
        gradient = jax.tree.map(lambda g: jnp.where(accepted, g, 0.0), gradient)
        changes, new_state = transform.update(gradient, state, networks)
        changes = jax.tree.map(lambda change: -rate * change, changes)
        keep = partial(jax.tree.map, lambda new, old: jnp.where(accepted, new, old))
        return (
            keep(optax.apply_updates(networks, changes), networks),
            keep(new_state, state),
            terms | {"loss": loss, "norm": norm, "dropped": 1.0 - accepted},
        )

    return update


def history(folder: Path) -> list[dict[str, Any]]:
    """Return the rows that a training logged every hundred updates; of a repeated update, the last one.

    A line that was cut off is left out.
    """
    path, rows = folder / HISTORY, list[dict[str, Any]]()
    for line in path.read_text().splitlines() if path.is_file() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return [row for _, row in sorted({row["update"]: row for row in rows}.items())]


class TrainingLog:
    """Loss, norms and drops of a run: means of updates, for `train`'s log, a file and TensorBoard."""

    def __init__(self, folder: Path, first: int, batch: int) -> None:
        """Begin to log updates from number `first` on, of so many sequences each."""
        self.folder, self.first, self.batch, self.begin = folder, first, batch, time.perf_counter()
        before = next((row for row in history(folder) if row["update"] == first), {})
        self.seconds_before, dropped = before.get("seconds", 0.0), before.get("dropped_in_all", 0)
        self.content: dict[str, Any] = {
            "history": [], "dropped": dropped, "stopped_early": False, "seconds": self.seconds_before
        }  # fmt: skip
        self.recent: list[dict[str, float]] = []
        self.dropped_in_a_row = 0

    def add(self, terms: dict[str, Array]) -> None:
        """Add the losses and norms of an update."""
        values = {name: float(value) for name, value in terms.items()}
        self.recent.append(values)
        self.content["dropped"] += int(values["dropped"])
        self.dropped_in_a_row = self.dropped_in_a_row + 1 if values["dropped"] else 0

    def write(self, board: Any, updates: int, unroll: int, now: float) -> str:
        """Write the means since the last call, after so many updates; return them as a note for the progress bar."""
        finite = [row for row in self.recent if np.isfinite(row["loss"])] or self.recent
        mean = {name: float(np.mean([row[name] for row in finite])) for name in self.recent[-1]}
        rate = (updates - self.first) * self.batch / (now - self.begin)
        self.content["seconds"] = self.seconds_before + now - self.begin
        totals = {"seconds": self.content["seconds"], "dropped_in_all": self.content["dropped"]}
        row = {"update": updates, "unroll": unroll, **mean, "sequences_per_second": rate, **totals}
        self.content["history"].append(row)
        with (self.folder / HISTORY).open("a") as file:
            file.write(json.dumps(row) + "\n")
        for name, value in row.items():
            board.add_scalar(name, value, updates)
        self.recent = []
        return f"loss {mean['loss']:.3g}, {rate:.0f} sequences/s"


def train(
    model: Model,
    recipe: Recipe,
    sources: Sequence[tuple[Trajectories, float]],
    folder: Path,
    start: Weights | None = None,
    quiet: bool = False,
    seconds: float = math.inf,
) -> tuple[Weights, dict[str, Any]]:
    """Train on sources of (trajectories, share); return the weights and a log of loss, norms and drops.

    folder: of checkpoints, from the last of which an interrupted run is resumed, and of logs for TensorBoard. start:
    weights to continue from; initial ones by default. seconds: only as many of the updates as fit into them, judged by
    the first. Where a hundred batches in a row are dropped, the last good weights are returned and the log says so.
    """
    from tensorboardX import SummaryWriter  # whose import sets a variable of the environment

    random = np.random.default_rng(recipe.seed)
    windows = Windows(model.scene, sources, recipe)
    weights = start or statistics_of(model, windows, random)
    manager = ocp.CheckpointManager(
        (folder / "checkpoints").absolute(), options=ocp.CheckpointManagerOptions(max_to_keep=1, create=True)
    )
    training, weights = _restored(manager, recipe, weights)
    update = jax.jit(update_of(model, recipe, weights), donate_argnums=(0, 1))
    index = first = int(training.update)
    log, saved = TrainingLog(folder, first, recipe.batch), time.perf_counter()
    networks, state = jax.tree.map(jnp.copy, training.networks), training.optimiser  # `update` consumes them
    # A checkpoint is written beside training: closing the manager, however training ends, waits for the last.
    board_folder = str(folder / "tensorboard")
    with closing(manager), _progress_bar(quiet) as bar, SummaryWriter(board_folder) as board:
        task = bar.add_task("", total=recipe.updates, completed=first, note="")
        draw: Callable[[np.random.Generator, int], Batch | StepExamples] = windows.draw
        if isinstance(model, ResidualModel) and index < recipe.updates:
            bar.update(task, note="physics of all steps, once")
            draw = partial(windows.draw_examples, table_of(model, windows.sources))
        while index < recipe.updates:
            batch = draw(np.random.default_rng((recipe.seed, index)), recipe.unroll(index))
            key = jax.random.fold_in(jax.random.key(recipe.seed), index)
            networks, state, terms = update(networks, state, key, batch, learning_rate(recipe, index))
            log.add(terms)
            if (index + 1) % 100 == 0 or index + 1 == recipe.updates:
                now = time.perf_counter()
                bar.update(task, completed=index + 1, note=log.write(board, index + 1, recipe.unroll(index), now))
                if now - saved > 60 or index + 1 == recipe.updates:
                    content = (TrainingState(networks, state, index + 1), weights[1:])
                    manager.save(index + 1, args=ocp.args.StandardSave(content))
                    saved = now
            if log.dropped_in_a_row >= 100:
                log.content["stopped_early"] = True
                break
            index += 1
            if index == first + 1:
                compiled = time.perf_counter()
            elif index == first + TIMED and math.isfinite(seconds):
                now = time.perf_counter()
                updates_left = (seconds - (now - log.begin)) / ((now - compiled) / (TIMED - 1))
                recipe = replace(recipe, updates=min(recipe.updates, index + max(1, int(updates_left))))
                bar.update(task, total=recipe.updates)
    return weights._replace(networks=networks), log.content


def _restored(manager: Any, recipe: Recipe, weights: Weights) -> tuple[TrainingState, Weights]:
    """Return the state of training in the last checkpoint with its weights; that of no update where there is none."""
    training = TrainingState(weights.networks, optimiser(recipe).init(weights.networks), 0)
    if manager.latest_step() is None:
        return training, weights
    restored = manager.restore(manager.latest_step(), args=ocp.args.StandardRestore((training, weights[1:])))
    # Restored arrays are bound to one device, but a simulator may use several.
    restored = jax.tree.map(lambda array: jnp.asarray(np.asarray(array)), restored)
    training = TrainingState(*restored[0])
    return training, Weights(training.networks, *restored[1])


def _progress_bar(quiet: bool) -> Progress:
    columns = (
        TextColumn("training"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[note]}"), TimeRemainingColumn(),
    )  # fmt: skip
    return Progress(*columns, disable=quiet)
