"""Page on which a kick is planned and watched, live while it runs and again afterwards.

Planning, execution and drawing are separate: the planner passes new data to the page and continues; a thread of the
page draws the latest data, at most 25 times a second; input of clients is validated and queued until the planner reads
it.
"""

from __future__ import annotations

import queue
import threading
import time as clock
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import Literal

import numpy as np
import viser

from larp_model.errors import InputError
from larp_model.scene import Scene
from larp_model.state import POSITION
from viewer.camera import View
from viewer.clients import Clients, Files
from viewer.handles import Handles
from viewer.live_data import LiveData, StateUpdate
from viewer.panel import Panel
from viewer.recording import Recording, mask_unpredicted, nearest_approach
from viewer.server import address_of, close_server, open_server
from viewer.settings import Offer, Push, Settings
from viewer.stage import LEGEND, Stage, points_in_view

FRAME = 1.0 / 25.0  # s
# Clients that are served at the full frame rate; with more it drops, for each of them costs the planner some time.
FULL_RATE_CLIENTS = 5

Mode = Literal["waiting", "planned", "running", "replay"]


class PageClosedError(Exception):
    """Error raised by calls that wait for the page once it is closed."""


class LivePage:
    """Page that follows a kick while it runs, and plays its recording once it is over.

    `begin`, `planned`, `update` and `finish` return at once; a thread draws one state after the other, and skips some
    if they arrive faster than they can be drawn. With an offer, users choose the settings of the next kick on the page:
    see `settings` and `next_request`. Leaving the `with` block closes the page.
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
        self._lock, self._closed, self._wake = threading.RLock(), threading.Event(), threading.Event()
        self._idle = threading.Event()  # set while the planner waits for the clock
        self._changes = self._frames = 0
        self._requests: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._mode: Mode = "waiting"
        self._stage: Stage | None = None
        self._handles: Handles | None = None
        self._live: LiveData | None = None
        self._recording: Recording | None = None
        self._beside: Recording | None = None
        self._drawn_frame: tuple[int, frozenset[str]] | None = None  # row of the recording that is drawn, and ghosts
        self._single_steps = 0  # single steps still to take while paused
        self._clients = Clients(self._server, self._camera)
        self.files: Files | None = None
        self._panel = Panel(self._server.gui, self._handle_request, self._change, offer)
        self._server.on_client_connect(self._clients.connect)
        self._server.on_client_disconnect(self._clients.disconnect)
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    # Input of users.

    def _change(self) -> None:
        with self._lock:
            self._changes += 1
            if self._stage and self._handles and self._mode != "replay":
                self._stage.lane.aim(np.array(self._handles.target))
        self._wake.set()

    def _handle_request(self, request_name: str, client: viser.ClientHandle | None) -> None:
        """Handle at once requests that concern only the page, and queue all others for the planner."""
        if request_name == "play":
            self._panel.playing = not self._panel.playing
        elif request_name == "step":
            with self._lock:
                self._panel.playing = False
                self._single_steps += self._mode == "running"
                if self._recording is not None:
                    self._panel.move(self._recording.scene.dt)
        elif request_name == "weights":
            self._panel.reset_weights()
            self._change()
        elif request_name == "look":
            with self._lock:
                self._drawn_frame = None
                if self._live:
                    self._live.state_is_new = self._live.plan_is_new = True
        elif request_name.startswith("view ") and client is not None:
            self._clients.set_view(client, request_name.removeprefix("view "))
        elif request_name.startswith("download ") and client is not None:
            self._clients.download(client, request_name.removeprefix("download "), self._recording, self.files)
        else:
            self._requests.put(request_name)
        self._wake.set()

    def request(self, name: str) -> None:
        """Request an action by name as a client would, for instance "kick", "reset" or "push ball"."""
        self._handle_request(name, None)

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
    def settings(self) -> Settings:
        """Return the settings now chosen on the page; requires an offer, and `begin` before."""
        with self._lock:
            assert self._handles is not None
            return Settings(
                self._handles.target, self._handles.spot, self._handles.roll, **self._panel.chosen_settings()
            )

    @property
    def changes(self) -> int:
        """Return the number of times that a setting has changed."""
        return self._changes

    def next_request(self, seconds: float = 0.0) -> str | None:
        """Return the next request, or None if none arrives within `seconds`. Raises `PageClosedError` once closed."""
        end = clock.monotonic() + seconds
        while True:
            if self._closed.is_set():
                raise PageClosedError
            with suppress(queue.Empty):
                return self._requests.get_nowait()
            if (left := end - clock.monotonic()) <= 0.0:
                return None
            self._wake.clear()
            if self._requests.empty():
                self._wake.wait(left)
                if self._requests.empty():
                    return None

    def push(self, name: str) -> Push:
        """Return the push set on the page, for the body with this name."""
        return Push(name, self._panel.push())

    def hold(self, until: float) -> None:
        """Wait until `until` [s] of the monotonic clock, and for as long as the page is paused."""
        self._idle.set()
        try:
            self._wait_for(until)
        finally:
            self._idle.clear()

    def _wait_for(self, until: float) -> None:
        while not self._closed.is_set():
            if self._panel.playing:
                left = until - clock.monotonic()
                if left <= 0.0:
                    return
                self._closed.wait(min(left, FRAME))
            else:
                with self._lock:
                    if self._single_steps:
                        self._single_steps -= 1
                        return
                if not self._requests.empty():
                    return  # the request may be to end
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
            link_positions = (
                np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.8)]) if state is None else np.asarray(state)[:, POSITION]
            )
            self._stage.frame(np.concatenate([link_positions, np.asarray(target, float)[None]]))
            self._recording, self._beside, self._live = None, None, None
            self._mode, self._single_steps = "waiting", 0
            if self.offer is not None:
                assert state is not None
                ball = self._stage.lane.position(state)
                self._handles = Handles(self._server, self.offer, tuple(target), ball, self._change)
            if state is not None:
                self._stage.lane.show(state)
            self._panel.hide_clock()

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
                self._handles.show_all(True)
            self._stage.compare(None)
            self._recording, self._beside, self._mode = None, None, "planned"
            self._live = LiveData(np.array(state), 0.0, [], mask_unpredicted(expected), 0.0, fan, reference)
            self._panel.hide_clock()

    def update(
        self,
        state: np.ndarray,
        predicted: np.ndarray | None,
        time: float,
        reference: np.ndarray | None = None,
        estimate: np.ndarray | None = None,
    ) -> None:
        """Show the state (L, 13) of the ground truth at `time` [s].

        predicted: (H, L, 13), the model's states at time, time + dt, ..., if they were just predicted; otherwise None.
        reference, estimate: states (L, 13), if they are to be drawn.
        """
        with self._lock:
            if self._stage is None:
                raise InputError("update came before begin, but the page needs a scene first")
            if self._mode != "running":
                self._mode, self._recording, self._beside, self._single_steps = "running", None, None, 0
                self._live, self._panel.playing = LiveData(np.array(state), time), True
                self._stage.compare(None)
                if self._handles:
                    self._stage.lane.aim(np.array(self._handles.target))
                    self._handles.show_all(False)
                self._panel.hide_clock()
            assert self._live is not None
            self._live.updates.append(StateUpdate(np.array(state), time, predicted, reference, estimate))

    def finish(self, recording: Recording, beside: Recording | None = None) -> None:
        """Load a recording for replay, and optionally another to be drawn beside it."""
        with self._lock:
            if self._stage is None or self.offer is None:
                self.begin(recording.scene, recording.target, recording.traced)
            stage = self._stage
            assert stage is not None
            stage.lane.aim(recording.target)
            stage.frame(points_in_view(recording))
            stage.lane.trace(recording.path, recording.predicted_path)
            stage.lane.fan(None)
            lane = stage.compare(None if beside is None else beside.target)
            if lane is not None and beside is not None:
                lane.trace(beside.path, beside.predicted_path)
            if self._handles:
                self._handles.show_all(True)
            recordings = [recording, *([] if beside is None else [beside])]
            self._panel.write("\n\n".join([*map(summary_text, recordings), LEGEND]))
            self._panel.play(max(replayed.duration for replayed in recordings), recording.scene.dt)
            self._recording, self._beside, self._drawn_frame, self._live = recording, beside, None, None
            self._mode = "replay"

    def show_message(self, text: str) -> None:
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
            self._wake.set()
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
            pace = FRAME * max(1.0, len(self._clients.views) / FULL_RATE_CLIENTS)
            if self._mode == "running":
                self._idle.wait(pace)  # otherwise it would take one of few cores from the planner
            now = clock.monotonic()
            due = max(due + pace, now + 0.5 * pace)
            with self._lock:
                if self._recording is not None:
                    self._draw_recording(self._recording, now - last)
                elif self._stage is not None and self._live is not None:
                    self._draw_live(self._stage, self._live)
            last = now

    def _camera(self, view: View, aspect: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return position (3,) and point looked at (3,) [m] of a view; None before `begin`."""
        with self._lock:
            if self._stage is None:
                return None
            camera = self._stage.camera(view, aspect)
            return camera.position, self._stage.look_at_point(camera)

    def _draw_recording(self, recording: Recording, elapsed: float) -> None:
        stage = self._stage
        assert stage is not None
        row = round(self._panel.advance(elapsed) / recording.scene.dt)
        ghosts = frozenset(self._panel.ghosts)
        if (row, ghosts) == self._drawn_frame:
            return
        for lane, replayed in ((stage.lane, recording), (stage.beside, self._beside)):
            if lane is not None and replayed is not None:
                lane_row = min(row, len(replayed.states) - 1)
                lane.visible_ghosts = set(ghosts)
                lane.show(
                    replayed.states[lane_row],
                    prediction=replayed.predicted_at(lane_row),
                    reference=replayed.reference_at(lane_row),
                    estimate=replayed.estimate_at(lane_row),
                )
        self._clients.follow(stage.lane.position(recording.states[min(row, len(recording.states) - 1)]))
        self._drawn_frame = row, ghosts
        self._frames += 1

    def _draw_live(self, stage: Stage, live: LiveData) -> None:
        """Draw what has changed since the last frame; the ghost of a plan that is not executed yet keeps moving."""
        live.advance()
        lane, plan, is_waiting = stage.lane, live.plan, self._mode == "planned"
        if not live.state_is_new and not (is_waiting and self._panel.playing):
            return
        lane.visible_ghosts = self._panel.ghosts
        predicted = None
        if plan is not None:
            step = round((live.time - live.plan_time) / stage.scene.dt)
            if is_waiting:
                step = int(clock.monotonic() / stage.scene.dt * self._panel.speed) % len(plan)
            predicted = plan[step] if 0 <= step < len(plan) else None
        lane.show(live.state, prediction=predicted, reference=live.reference, estimate=live.estimate)
        self._frames += 1
        if live.state_is_new:
            path = lane.position(np.array(live.path)) if live.path else None
            miss = lane.trace(path, None if plan is None else lane.position(plan), live.plan_is_new)
            if live.plan_is_new:
                lane.fan(*(live.fan or (None, None)) if "fan" in lane.visible_ghosts else (None, None))
            if self._mode == "running" or self.offer is None:
                self._panel.write(f"**Kicking**, {live.time:.2f} s: {100.0 * miss:.1f} cm from the target\n\n{LEGEND}")
            self._clients.follow(lane.position(live.state))
        live.state_is_new = live.plan_is_new = False


def summary_text(recording: Recording) -> str:
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
