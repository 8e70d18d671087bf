"""Page on which a kick is planned and watched, live while it runs and again afterwards.

Planning, execution and drawing are separate: the planner passes new data to the page and continues; a thread of the
page draws the latest data, at most 25 times a second; input of clients is validated and queued until the planner reads
it.
"""

from __future__ import annotations

import queue
import threading
import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, NamedTuple

import numpy as np
import viser

from larp_model.errors import InputError
from larp_model.scene import Scene
from larp_model.state import POSITION
from viewer.camera import VIEWS, View
from viewer.checked import within
from viewer.handles import Handles
from viewer.panel import Panel
from viewer.recording import Recording, known, nearest_approach
from viewer.server import address_of, close_server, open_server
from viewer.stage import LEGEND, Stage, whole
from viewer.wishes import Offer, Push, Wishes

FRAME = 1.0 / 25.0  # s
# Frames by which drawing may lag behind the execution, whose states arrive in bursts.
BEHIND = 5
# Clients that are served at the full frame rate; with more it drops, for each of them costs the planner some time.
AT_FULL_PACE = 5
FOLLOWED = (-2.2, -3.2, 1.4)  # m, from the ball to a camera that follows it

Mode = Literal["waiting", "planned", "running", "replay"]


class PageClosedError(Exception):
    """Error raised by calls that wait for the page once it is closed."""


class Moment(NamedTuple):
    """State (L, 13) of the ground truth at a time [s], the new prediction from there, and the reference's state."""

    state: np.ndarray
    time: float
    predicted: np.ndarray | None
    reference: np.ndarray | None


@dataclass
class News:
    """Data to be drawn next; a plan, fan or reference that is None is not drawn."""

    state: np.ndarray
    time: float
    path: list[np.ndarray] = field(default_factory=list)  # states (L, 13) so far
    plan: np.ndarray | None = None
    plan_time: float = 0.0
    fan: tuple[np.ndarray, np.ndarray] | None = None
    reference: np.ndarray | None = None
    fresh: bool = True  # not drawn yet
    planned: bool = True  # the plan and its fan are not drawn yet
    waiting: deque[Moment] = field(default_factory=deque)

    def go_on(self) -> None:
        """Advance to the next waiting moment, or skip some if many wait: they arrive in bursts, between plans."""
        for _ in range(-(-len(self.waiting) // BEHIND)):
            moment = self.waiting.popleft()
            if moment.predicted is not None:
                self.plan, self.plan_time, self.planned = known(moment.predicted), moment.time, True
            self.path.append(moment.state)
            self.state, self.time, self.reference, self.fresh = moment.state, moment.time, moment.reference, True


class LivePage:
    """Page that follows a kick while it runs, and plays its recording once it is over.

    `begin`, `planned`, `update` and `finish` return at once; a thread draws one state after the other, and skips some
    if they arrive faster than they can be drawn. With an offer, users choose the settings of the next kick on the page:
    see `wishes` and `asked`. Leaving the `with` block closes the page.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        offer: Offer | None = None,
        allowed: Sequence[str] = (),
    ) -> None:
        """Open the page at an address.

        allowed: names of proxies through which the page is reached as well; see `server.open_server`.
        """
        self._server = open_server(host, port, allowed)
        self.address = address_of(self._server)
        self.offer = offer
        self._lock, self._closed, self._moved = threading.RLock(), threading.Event(), threading.Event()
        self._rests = threading.Event()  # set while the planner waits for the clock
        self._changes = self._frames = 0
        self._asked: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._mode: Mode = "waiting"
        self._stage: Stage | None = None
        self._handles: Handles | None = None
        self._news: News | None = None
        self._recording: Recording | None = None
        self._beside: Recording | None = None
        self._drawn: tuple[int, frozenset[str]] | None = None  # row of the recording that is drawn, and ghosts
        self._single = 0  # single steps still to take while paused
        self._views: dict[int, tuple[str, float]] = {}  # by client: its view, and the aspect this was for
        self._filing = threading.Lock()
        self.files: Callable[[str, Recording], tuple[str, bytes]] | None = None
        self._panel = Panel(self._server.gui, self._ask, self._change, offer)
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._part)
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    # Input of users.

    def _change(self) -> None:
        with self._lock:
            self._changes += 1
            if self._stage and self._handles and self._mode != "replay":
                self._stage.lane.aim(np.array(self._handles.target))
        self._moved.set()

    def _ask(self, name: str, client: viser.ClientHandle | None) -> None:
        """Handle at once requests that concern only the page, and queue all others for the planner."""
        if name == "play":
            self._panel.playing = not self._panel.playing
        elif name == "step":
            with self._lock:
                self._panel.playing = False
                self._single += self._mode == "running"
                if self._recording is not None:
                    self._panel.move(self._recording.scene.dt)
        elif name == "weights":
            self._panel.as_at_first()
            self._change()
        elif name == "look":
            with self._lock:
                self._drawn = None
                if self._news:
                    self._news.fresh = self._news.planned = True
        elif name.startswith("view ") and client is not None:
            self._look(client, name.removeprefix("view "))
        elif name.startswith("download ") and client is not None:
            self._download(client, name.removeprefix("download "))
        else:
            self._asked.put(name)
        self._moved.set()

    def ask(self, name: str) -> None:
        """Request an action by name as a client would, for instance "kick", "reset" or "push ball"."""
        self._ask(name, None)

    def aim(self, target: np.ndarray) -> None:
        """Move the target to (3,) [m], clipped to the box that is offered, as if it had been dragged."""
        with self._lock:
            assert self._handles is not None
            self._handles.aim(target)
        self._change()

    @property
    def frames(self) -> int:
        """Return the number of frames drawn so far."""
        return self._frames

    @property
    def mode(self) -> Mode:
        """Return whether the page is waiting, shows a plan, follows a run or replays."""
        return self._mode

    @property
    def wishes(self) -> Wishes:
        """Return the settings now chosen on the page; requires an offer, and `begin` before."""
        with self._lock:
            assert self._handles is not None
            return Wishes(self._handles.target, self._handles.spot, self._handles.roll, **self._panel.asked_for())

    @property
    def changes(self) -> int:
        """Return the number of times that a setting has changed."""
        return self._changes

    def asked(self, seconds: float = 0.0) -> str | None:
        """Return the next request, or None if none arrives within `seconds`. Raises `PageClosedError` once closed."""
        end = clock.monotonic() + seconds
        while True:
            if self._closed.is_set():
                raise PageClosedError
            with suppress(queue.Empty):
                return self._asked.get_nowait()
            if (left := end - clock.monotonic()) <= 0.0:
                return None
            self._moved.clear()
            if self._asked.empty():
                self._moved.wait(left)
                if self._asked.empty():
                    return None

    def push(self, name: str) -> Push:
        """Return the push set on the page, for the body with this name."""
        return Push(name, self._panel.push())

    def hold(self, until: float) -> None:
        """Wait until `until` [s] of the monotonic clock, and for as long as the page is paused."""
        self._rests.set()
        try:
            self._wait_for(until)
        finally:
            self._rests.clear()

    def _wait_for(self, until: float) -> None:
        while not self._closed.is_set():
            if self._panel.playing:
                left = until - clock.monotonic()
                if left <= 0.0:
                    return
                self._closed.wait(min(left, FRAME))
            else:
                with self._lock:
                    if self._single:
                        self._single -= 1
                        return
                if not self._asked.empty():
                    return  # it may be asked to end
                self._closed.wait(FRAME)
        raise PageClosedError

    @property
    def playing(self) -> bool:
        """Return whether time runs on the page, that is, whether it is not paused."""
        return self._panel.playing

    @property
    def speed(self) -> float:
        """Return the speed of time on the page, as a fraction of real time."""
        return self._panel.speed

    # Output to the page.

    def begin(self, scene: Scene, target: np.ndarray, traced: int = -1, state: np.ndarray | None = None) -> None:
        """Draw the scene without motion, as it is before a kick.

        target: (3,) [m]. traced: row in the state of the link whose path is drawn. state: (L, 13), the usual initial
        state; required with an offer.
        """
        with self._lock:
            self._stage = Stage(self._server, scene, target, traced)
            seen = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.8)]) if state is None else np.asarray(state)[:, POSITION]
            self._stage.frame(np.concatenate([seen, np.asarray(target, float)[None]]))
            self._recording, self._beside, self._news = None, None, None
            self._mode, self._single = "waiting", 0
            if self.offer is not None:
                assert state is not None
                ball = self._stage.lane.position(state)
                self._handles = Handles(self._server, self.offer, tuple(target), ball, self._change)
            if state is not None:
                self._stage.lane.show(state)
            self._panel.watch()

    def planned(
        self,
        state: np.ndarray,
        expected: np.ndarray,
        fan: tuple[np.ndarray, np.ndarray] | None = None,
        reference: np.ndarray | None = None,
    ) -> None:
        """Show a plan that waits to be executed: its expected states (H, L, 13) from a state (L, 13) on.

        fan: other candidates' paths (N, T, 3) [m] of the traced link, and their costs (N,). reference: state (L, 13).
        """
        with self._lock:
            assert self._stage is not None
            if self._handles:
                self._stage.lane.aim(np.array(self._handles.target))
                self._handles.shown(True)
            self._stage.compare(None)
            self._recording, self._beside, self._mode = None, None, "planned"
            self._news = News(np.array(state), 0.0, [], known(expected), 0.0, fan, reference)
            self._panel.watch()

    def update(
        self, state: np.ndarray, predicted: np.ndarray | None, time: float, reference: np.ndarray | None = None
    ) -> None:
        """Show the state (L, 13) of the ground truth at `time` [s].

        predicted: (H, L, 13), the model's states at time, time + dt, ..., if they were just predicted; otherwise None.
        reference: state (L, 13), if it is to be drawn.
        """
        with self._lock:
            if self._stage is None:
                raise InputError("update came before begin, but the page needs a scene first")
            if self._mode != "running":
                self._mode, self._recording, self._beside, self._single = "running", None, None, 0
                self._news, self._panel.playing = News(np.array(state), time), True
                self._stage.compare(None)
                if self._handles:
                    self._stage.lane.aim(np.array(self._handles.target))
                    self._handles.shown(False)
                self._panel.watch()
            assert self._news is not None
            self._news.waiting.append(Moment(np.array(state), time, predicted, reference))

    def finish(self, recording: Recording, beside: Recording | None = None) -> None:
        """Load a recording for replay, and optionally another to be drawn beside it."""
        with self._lock:
            if self._stage is None or self.offer is None:
                self.begin(recording.scene, recording.target, recording.traced)
            stage = self._stage
            assert stage is not None
            stage.lane.aim(recording.target)
            stage.frame(whole(recording))
            stage.lane.trace(recording.path, recording.predicted_path)
            stage.lane.fan(None)
            lane = stage.compare(None if beside is None else beside.target)
            if lane is not None and beside is not None:
                lane.trace(beside.path, beside.predicted_path)
            if self._handles:
                self._handles.shown(True)
            both = [recording, *([] if beside is None else [beside])]
            self._panel.write("\n\n".join([*map(described, both), LEGEND]))
            self._panel.play(max(each.duration for each in both), recording.scene.dt)
            self._recording, self._beside, self._drawn, self._news = recording, beside, None, None
            self._mode = "replay"

    def tell(self, text: str) -> None:
        """Show a status text in Markdown."""
        self._panel.write(f"{text}\n\n{LEGEND}")

    @property
    def panel(self) -> Panel:
        """Return the controls beside the picture."""
        return self._panel

    @property
    def recording(self) -> Recording | None:
        """Return the recording that is being replayed, or None."""
        return self._recording

    def wait(self) -> None:
        """Keep the page open until it is closed or the user interrupts."""
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop drawing and serving."""
        if not self._closed.is_set():
            self._closed.set()
            self._moved.set()
            self._thread.join()
            close_server(self._server)

    def __enter__(self) -> LivePage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Drawing.

    def _draw(self) -> None:
        last = due = clock.monotonic()
        while not self._closed.wait(max(0.0, due - clock.monotonic())):
            pace = FRAME * max(1.0, len(self._views) / AT_FULL_PACE)
            if self._mode == "running":
                self._rests.wait(pace)  # otherwise it would take one of few cores from the planner
            now = clock.monotonic()
            due = max(due + pace, now + 0.5 * pace)
            with self._lock:
                if self._recording is not None:
                    self._draw_recording(self._recording, now - last)
                elif self._stage is not None and self._news is not None:
                    self._draw_news(self._stage, self._news)
            last = now

    def _draw_recording(self, recording: Recording, elapsed: float) -> None:
        stage = self._stage
        assert stage is not None
        row = round(self._panel.advance(elapsed) / recording.scene.dt)
        ghosts = frozenset(self._panel.ghosts)
        if (row, ghosts) == self._drawn:
            return
        for lane, each in ((stage.lane, recording), (stage.beside, self._beside)):
            if lane is not None and each is not None:
                own = min(row, len(each.states) - 1)
                lane.shown = set(ghosts)
                lane.show(each.states[own], prediction=each.predicted_at(own), reference=each.reference_at(own))
        self._follow(stage.lane.position(recording.states[min(row, len(recording.states) - 1)]))
        self._drawn = row, ghosts
        self._frames += 1

    def _draw_news(self, stage: Stage, news: News) -> None:
        """Draw what has changed since the last frame; the ghost of a plan that waits keeps moving."""
        news.go_on()
        lane, plan, waits = stage.lane, news.plan, self._mode == "planned"
        if not news.fresh and not (waits and self._panel.playing):
            return
        lane.shown = self._panel.ghosts
        expected = None
        if plan is not None:
            step = round((news.time - news.plan_time) / stage.scene.dt)
            if waits:
                step = int(clock.monotonic() / stage.scene.dt * self._panel.speed) % len(plan)
            expected = plan[step] if 0 <= step < len(plan) else None
        lane.show(news.state, prediction=expected, reference=news.reference)
        self._frames += 1
        if news.fresh:
            path = lane.position(np.array(news.path)) if news.path else None
            miss = lane.trace(path, None if plan is None else lane.position(plan), news.planned)
            if news.planned:
                lane.fan(*(news.fan or (None, None)) if "fan" in lane.shown else (None, None))
            if self._mode == "running" or self.offer is None:
                self._panel.write(f"**Kicking**, {news.time:.2f} s: {100.0 * miss:.1f} cm from the target\n\n{LEGEND}")
            self._follow(lane.position(news.state))
        news.fresh = news.planned = False

    # Cameras and files, each client's own.

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._look(client, "side")

        # The panel and the size of the window change the aspect of the picture.
        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            view, aspect = self._views.get(client.client_id, ("", 1.0))
            if view and abs(aspect_of(camera) / aspect - 1.0) > 0.02:
                self._look(client, view)

    def _part(self, client: viser.ClientHandle) -> None:
        self._views.pop(client.client_id, None)

    def _look(self, client: viser.ClientHandle, view: str) -> None:
        aspect = aspect_of(client.camera)
        self._views[client.client_id] = view, aspect
        chosen: View | None = next((each for each in VIEWS if each == view), None)
        with self._lock:
            if self._stage is None or chosen is None:
                return
            camera, stage = self._stage.camera(chosen, aspect), self._stage
        with client.atomic():
            client.camera.position, client.camera.look_at = camera.place, stage.middle(camera)

    def _follow(self, ball: np.ndarray) -> None:
        for number, client in self._server.get_clients().items():
            if self._views.get(number, ("",))[0] == "follow":
                with client.atomic(), suppress(ValueError):  # of a client whose camera is invalid
                    client.camera.position, client.camera.look_at = ball + FOLLOWED, ball

    def _download(self, client: viser.ClientHandle, kind: str) -> None:
        """Make a file of the recording that is replayed, in a thread of its own, and send it to one client."""
        recording, files = self._recording, self.files
        if recording is None or files is None or not self._filing.acquire(blocking=False):
            why = "Kick first." if recording is None else "Another file is being made."
            client.add_notification("Not now", why, auto_close_seconds=4.0)
            return

        def make() -> None:
            try:
                name, content = files(kind, recording)
                if client.client_id in self._server.get_clients():  # it may have left meanwhile
                    client.send_file_download(name, content, save_immediately=True)
            finally:
                self._filing.release()

        threading.Thread(target=make, daemon=True).start()


def aspect_of(camera: viser.CameraHandle) -> float:
    """Return width over height of a client's picture, clipped to a sensible range."""
    return within(camera.aspect, 0.2, 5.0)


def described(recording: Recording) -> str:
    """Return the title and the summary of a recording in Markdown."""
    miss = nearest_approach(recording.path, recording.target).distance
    facts = {"nearest to the target": f"{100.0 * miss:.1f} cm", **recording.summary}
    lines = (f"- {name}: {text}" for name, text in facts.items())
    return "\n".join([f"**{recording.title or 'Replay'}**", "", *lines])


def show(recording: Recording, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Play a recording in the browser until interrupted."""
    with LivePage(host, port) as page:
        page.finish(recording)
        print(f"Watch it at {page.address} (Ctrl-C ends)", flush=True)
        page.wait()
