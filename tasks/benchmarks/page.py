"""Cost of the live web page: planning times with and without watching clients, and resources that it leaves behind.

Clients are websockets that send a camera pose, receive every message and draw nothing. Some read slowly; some leave
and reconnect. They run in a process of their own, as browsers do.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import viser
from matplotlib.figure import Figure
from rich.table import Table
from viser._messages import ViewerCameraMessage
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from larp_model.errors import InputError
from mpc.loop import Execution
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.kick import USUAL, Kick
from tasks.live import Live, due
from tasks.live_choices import WORLD_WAITS, Choices, weights_for
from tasks.presets import PRESETS, PresetName
from tasks.session import Session
from tasks.targets import random_kick
from viewer import LivePage

if TYPE_CHECKING:
    from psutil import Process

# One in `SLOW` clients is slow: it waits `PATIENCE` [s] before each message.
SLOW, PATIENCE = 5, 0.5
# Duration of a visit of the client that reconnects again and again [s].
STAYS = 3.0
WARM_UP = 3
# Camera pose of a client: Viser does not count a client before it has sent one.
LOOKS = msgspec.msgpack.encode(
    ViewerCameraMessage(
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(2.0, -5.0, 1.5),
        fov=0.7,
        near=0.01,
        far=1000.0,
        image_height=900,
        image_width=1400,
        look_at=(2.0, 0.0, 1.0),
        up_direction=(0.0, 0.0, 1.0),
    ).as_serializable_dict()
)


@dataclass(frozen=True)
class PageSettings:
    """Settings of a run that its figures depend on; see the arguments of `main`."""

    kicks: int
    alone: int
    clients: int
    preset: PresetName
    seed: int

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        counts = f"--kicks {self.kicks} --alone {self.alone} --clients {self.clients}"
        return f"python -m tasks.benchmarks.page {counts} --preset {self.preset} --seed {self.seed}"


def watch(address: str, clients: int, visits: Synchronized[int]) -> None:
    """Connect `clients` clients until the process ends, and one more that visits repeatedly and counts in `visits`."""

    def one(number: int, seconds: float) -> None:
        end = time.monotonic() + seconds
        try:
            with connect(address, subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None) as socket:
                socket.send(LOOKS)
                while time.monotonic() < end:
                    if number % SLOW == SLOW - 1:
                        time.sleep(PATIENCE)
                    try:
                        socket.recv(timeout=0.2)
                    except TimeoutError:
                        continue
        except (ConnectionClosed, OSError):
            return

    threads = [threading.Thread(target=one, args=(number, 1e9), daemon=True) for number in range(clients)]
    for thread in threads:
        thread.start()
    while True:
        one(0, STAYS)
        with visits:
            visits.value += 1


def wait_until(condition: Callable[[], object], seconds: float = 120.0) -> float:
    """Wait until a condition is true and return the time that took [s].

    The condition is polled rarely, for polling takes time from the planner. Raises RuntimeError after `seconds`.
    """
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise RuntimeError(f"nothing happened for {seconds:g} s")
        time.sleep(0.02)
    return time.monotonic() - begin


def kick_row(live: Live, ask: Callable[[], None]) -> report.Row:
    """Return planning times, miss and frame rate from first to last step [1/s] of a kick on the page."""
    page, before = live.page, live.run
    drawn = list[tuple[float, int]]()
    ask()

    def is_done() -> bool:
        if page.mode == "running":
            drawn.append((time.monotonic(), page.frames))
        return live.run is not before and page.mode == "replay"

    wait_until(is_done)
    assert live.run is not None
    summary = live.run.summary
    return {
        "plan_seconds": summary["plan_seconds"],
        "replan_ms": summary["replan_ms"]["p50"],
        "truth_error_m": summary["truth_error_m"],
        "frames_per_second": (drawn[-1][1] - drawn[0][1]) / (drawn[-1][0] - drawn[0][0]),
    }


def drag_row(live: Live, target: np.ndarray) -> report.Row:
    """Drag the target and return the time until the new plan is drawn [s]."""
    page = live.page
    begin, plans = time.monotonic(), live.plans
    page.aim(target)
    wait_until(lambda: live.plans > plans)
    frames = page.frames
    wait_until(lambda: page.frames > frames + 1)
    return {"drag_seconds": time.monotonic() - begin}


def main(
    kicks: int = 20,
    alone: int = 20,
    clients: int = 10,
    preset: PresetName = "fast",
    seed: int = 7,
    json: Path = Path("runs/benchmarks/page.json"),
    publish: bool = False,
) -> None:
    """Measure what a page costs whoever plans, and whether it leaves anything behind.

    Args:
        kicks: with the page.
        alone: so many of them without it too.
        clients: that watch, a fifth of them slow; one more comes and goes.
        preset: of the plans.
        seed: of the targets.
        json: where the figures go.
        publish: update RESULTS.md.
    """
    if min(kicks, alone, clients) < 1:
        raise InputError(f"kicks, alone and clients are {kicks}, {alone} and {clients}, but must be at least 1")
    if find_spec("psutil") is None:
        raise InputError("psutil is not installed: pip install 'larp-mpc[bench]'")
    report.ready(json, publish)
    prepare_jax()
    settings = PageSettings(kicks, alone, clients, preset, seed)
    rows, usage = measure(settings, json)
    figures = summary(rows) | usage
    command = settings.command
    report.write_json(json, {"command": command, "hardware": report.hardware(), **figures, "rows": rows})
    report.write_picture(json.with_suffix(".png"), picture(rows))
    table = table_of(figures, f"The page: {kicks} kicks of {preset}, {clients} clients")
    report.show(table)
    if publish:
        report.publish("page", "The page", command, table)


def measure(settings: PageSettings, json: Path) -> tuple[dict[str, report.Row], dict[str, Any]]:
    """Return the rows of all kicks and drags by name, and the resources that the page took and left behind.

    json: where the figures go; an interrupted run resumes from the rows beside it.
    """
    import psutil

    random = np.random.default_rng(settings.seed)
    targets = [random_kick(random)[0] for _ in range(settings.kicks)]
    kick, preset = Kick.standard(), settings.preset
    choices = Choices(
        {"embedded": lambda: kick}, {preset: PRESETS[preset]}, ("larp",), weights_for(None), (WORLD_WAITS,)
    )
    process, begin = psutil.Process(), time.monotonic()
    session = Session(kick)
    session.run(USUAL, preset)  # what plans and steps keeps its threads
    threads_before = process.num_threads()
    with tempfile.TemporaryDirectory() as folder, LivePage(port=0, offer=choices.offer(kick)) as page:
        live = Live(page, choices, USUAL, Path(folder), settings.seed)
        thread = threading.Thread(target=live.serve)
        thread.start()
        wait_until(lambda: page.mode == "planned", 300.0)
        watching, visits = watchers(page, settings.clients, process)
        for _ in range(WARM_UP):
            kick_row(live, partial(page.request, "kick"))
        memory = process.memory_info().rss
        jobs = jobs_of(live, session, targets, settings)
        rows = dict(zip(jobs, report.collect(json, settings.command, jobs), strict=True))
        growth = process.memory_info().rss / memory - 1.0
        watching.kill()
        page.close()
        thread.join()
    return rows, {
        "memory_growth": growth,
        "sockets_left": len(process.net_connections("tcp")),
        "minutes": (time.monotonic() - begin) / 60.0,
        "visits": visits.value,
        "threads_before": threads_before,
        "threads_after": process.num_threads(),
    }


def watchers(page: LivePage, clients: int, process: Process) -> tuple[SpawnProcess, Synchronized[int]]:
    """Start the process of the clients; return it, and its count of visits, once all of them are connected.

    process: this one, which serves the page.
    """
    spawn = multiprocessing.get_context("spawn")
    visits = spawn.Value("i", 0)
    address = page.address.replace("http", "ws")
    watching = spawn.Process(target=watch, args=(address, clients, visits), daemon=True)
    watching.start()
    wait_until(lambda: len(process.net_connections("tcp")) > clients, 60.0)
    return watching, visits


def jobs_of(
    live: Live, session: Session, targets: list[np.ndarray], settings: PageSettings
) -> dict[str, Callable[[], report.Row]]:
    """Return the jobs by name; watched and unwatched kicks alternate, for the machine may become slower."""
    jobs: dict[str, Callable[[], report.Row]] = {}
    for index, target in enumerate(targets):
        jobs[f"drag {index}"] = partial(drag_row, live, target)
        jobs[f"watched {index}"] = partial(kick_row, live, partial(live.page.request, "kick"))
        if index < settings.alone:
            jobs[f"alone {index}"] = partial(unwatched_row, live, session, target, settings.preset, settings.seed)
    return jobs


def table_of(figures: dict[str, Any], title: str) -> Table:
    """Return a table with one line per figure."""
    table = Table("measure", "value", title=title)
    for name, value in (
        ("replan, watched and alone (median)", "{watched_ms:.0f} and {alone_ms:.0f} ms".format(**figures)),
        ("slower by (median of pairs)", f"{100 * figures['slower']:.1f} %"),
        (
            "from a drag to the new plan on the page (median, worst)",
            "{drag_s:.2f}, {drag_worst_s:.2f} s".format(**figures),
        ),
        ("drawn while it kicks", f"{figures['frames_per_second']:.0f} times a second"),
        ("memory grew by", f"{100 * figures['memory_growth']:.1f} %"),
        ("sockets left", str(figures["sockets_left"])),
        ("threads before and after", f"{figures['threads_before']} and {figures['threads_after']}"),
        ("clients that came and left", str(figures["visits"])),
        ("it took", f"{figures['minutes']:.0f} min"),
    ):
        table.add_row(name, value)
    return table


def unwatched_row(live: Live, session: Session, target: np.ndarray, preset: PresetName, seed: int) -> report.Row:
    """Return planning times of the same kick in real time without drawing.

    The pace is the same as on the page because planning after a pause is slower anyway.
    """
    due_at = time.monotonic()

    def observe(execution: Execution) -> None:
        nonlocal due_at
        due_at = due(due_at, session.task.scene.dt)
        time.sleep(max(0.0, due_at - time.monotonic()))

    live.page.panel.playing = False
    figures = session.run(target, preset, seed, observe=observe).summary
    live.page.panel.playing = True
    return {"plan_seconds": figures["plan_seconds"], "replan_ms": figures["replan_ms"]["p50"]}


def summary(rows: dict[str, report.Row]) -> dict[str, Any]:
    """Return medians and worst values over all rows."""

    def values(kind: str, name: str) -> np.ndarray:
        return np.array([row[name] for key, row in rows.items() if key.startswith(kind)])

    watched, alone = values("watched", "replan_ms"), values("alone", "replan_ms")
    paired = watched[: len(alone)]
    drags = values("drag", "drag_seconds")
    return {
        "watched_ms": float(np.median(paired)),
        "alone_ms": float(np.median(alone)),
        "slower": float(np.median(paired / alone) - 1.0),
        "drag_s": float(np.median(drags)),
        "drag_worst_s": float(drags.max()),
        "frames_per_second": float(np.median(values("watched", "frames_per_second"))),
    }


def picture(rows: dict[str, report.Row]) -> Figure:
    """Plot the median replan time of each kick, watched and alone."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for kind, colour in (("watched", "#d55e00"), ("alone", "#0072b2")):
        values = [row["replan_ms"] for key, row in rows.items() if key.startswith(kind)]
        axes.plot(values, marker="o", ls="", color=colour, label=kind)
    axes.set(xlabel="kick", ylabel="replan, median [ms]", title="Plans with and without a page", ylim=(0.0, None))
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run(main)
