"""The page on which a kick is watched, live while it runs and again afterwards."""

from __future__ import annotations

import io
import socket
import threading
import time as clock
from contextlib import redirect_stdout
from types import TracebackType

import numpy as np
import viser

from larp_model.scene import Scene
from viewer.panel import Panel
from viewer.recording import Recording
from viewer.stage import LEGEND, Stage

FRAME = 1.0 / 30.0  # s


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> None:
        """Any browser may ask for a public address; there is none."""


def open_server(host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """A silent Viser server on exactly this address; port 0 takes a free one.

    Raises ValueError where it cannot be had: Viser itself would move to another port, or try for ever.
    """
    if not 0 <= port < 2**16:
        raise ValueError(f"port is {port!r}, but must be in [0, 65536)")
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise ValueError(f"port {port} of host {host!r} cannot be opened: {error}; choose another") from None
    with redirect_stdout(io.StringIO()):
        server = _Server(host, port, verbose=False)
    if port and server.get_port() != port:
        close_server(server)
        raise ValueError(f"port {port} of host {host!r} was taken meanwhile; choose another")
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stop a server, silently."""
    with redirect_stdout(io.StringIO()):
        server.stop()


class LivePage:
    """A page that follows a kick while it runs, and plays its recording once it is over.

    `begin`, `update` and `finish` return at once; a thread draws. Where states come faster than they can be
    drawn, the latest wins. Leaving the `with` block closes the page.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._server = open_server(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._panel = Panel(self._server.gui)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._stage: Stage | None = None
        self._recording: Recording | None = None
        self._drawn: int | None = None  # row of the recording that is on the page
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    def begin(self, scene: Scene, target: np.ndarray, traced: int = -1) -> None:
        """Set the stage. target: (3,) [m]. traced: row in the state of the link whose path is drawn."""
        with self._lock:
            self._stage = Stage(self._server, scene, target, traced)
            self._recording, self._dt = None, scene.dt
            self._path: list[np.ndarray] = []
            self._plan: np.ndarray | None = None
            self._news: tuple[np.ndarray, float] | None = None
            self._panel.watch()

    def update(self, state: np.ndarray, predicted: np.ndarray | None, time: float) -> None:
        """The truth's state (L, 13) at `time` [s].

        predicted: (H, L, 13) of the model for time + dt, time + 2 dt, ..., if just asked; otherwise None.
        """
        with self._lock:
            if self._stage is None:
                raise ValueError("update came before begin, but the page needs a scene first")
            if predicted is not None:
                self._plan, self._plan_time = np.array(predicted), time
            self._path.append(self._stage.position(state).copy())
            self._news = np.array(state), time

    def finish(self, recording: Recording) -> None:
        """Offer the recording for play."""
        self.begin(recording.scene, recording.target, recording.traced)
        with self._lock:
            assert self._stage is not None
            miss = self._stage.trace(recording.path, recording.predicted_path)
            facts = {"nearest to the target": f"{100.0 * miss:.1f} cm", **recording.summary}
            lines = (f"- {name}: {text}" for name, text in facts.items())
            self._panel.write("\n".join([f"**{recording.title or 'Replay'}**", "", *lines, "", LEGEND]))
            self._panel.play(recording.duration, recording.scene.dt)
            self._recording, self._drawn = recording, None

    def wait(self) -> None:
        """Leave the page open until it is closed or the user interrupts."""
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop drawing and serving."""
        if not self._closed.is_set():
            self._closed.set()
            self._thread.join()
            close_server(self._server)

    def __enter__(self) -> LivePage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _draw(self) -> None:
        last = clock.monotonic()
        while not self._closed.wait(FRAME):
            now = clock.monotonic()
            with self._lock:
                if self._recording is not None:
                    self._draw_recording(self._recording, now - last)
                elif self._stage is not None and self._news is not None:
                    self._draw_news(self._stage, *self._news)
            last = now

    def _draw_recording(self, recording: Recording, elapsed: float) -> None:
        row = min(round(self._panel.advance(elapsed) / recording.scene.dt), len(recording.states) - 1)
        if row != self._drawn and self._stage is not None:
            self._stage.show(recording.states[row], recording.predicted_at(row))
            self._drawn = row

    def _draw_news(self, stage: Stage, state: np.ndarray, time: float) -> None:
        expected = None
        if self._plan is not None:
            step = round((time - self._plan_time) / self._dt) - 1
            expected = self._plan[step] if 0 <= step < len(self._plan) else None
        stage.show(state, expected)
        miss = stage.trace(np.array(self._path), None if self._plan is None else stage.position(self._plan))
        nearest = f"time {time:.2f} s, nearest to the target so far {100.0 * miss:.1f} cm"
        self._panel.write(f"{nearest}\n\n{LEGEND}")
        self._news = None


def show(recording: Recording, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Play a recording in the browser until interrupted."""
    with LivePage(host, port) as page:
        page.finish(recording)
        print(f"Watch it at {page.address} (Ctrl-C ends)", flush=True)
        page.wait()
