"""Clients of the page: the camera of each, and files that are sent to one of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import viser

from viewer.camera import VIEWS, View
from viewer.checked import within
from viewer.recording import Recording

FOLLOWED = (-2.2, -3.2, 1.4)  # m, from the ball to a camera that follows it

Files = Callable[[str, Recording], tuple[str, bytes]]
"""Function that returns the name and the content of a file of a recording, by the file's extension."""


class Clients:
    """Browsers that show the page: the view of each, and downloads."""

    def __init__(
        self, server: viser.ViserServer, camera: Callable[[View, float], tuple[np.ndarray, np.ndarray] | None]
    ) -> None:
        """Serve the clients of a server, once it calls `connect` and `disconnect`.

        camera: returns position (3,) and point looked at (3,) [m] of a view in a picture of this width over height, or
        None if there is nothing to see yet.
        """
        self._server, self._camera = server, camera
        self.views: dict[int, tuple[str, float]] = {}  # by client: its view, and the aspect this was for
        self._download_lock = threading.Lock()

    def connect(self, client: viser.ClientHandle) -> None:
        """Show the side view, and again whenever the aspect of the picture changes."""
        self.set_view(client, "side")

        # The panel and the size of the window change the aspect of the picture.
        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            view, aspect = self.views.get(client.client_id, ("", 1.0))
            if view and abs(aspect_of(camera) / aspect - 1.0) > 0.02:
                self.set_view(client, view)

    def disconnect(self, client: viser.ClientHandle) -> None:
        """Forget a client that has left."""
        self.views.pop(client.client_id, None)

    def set_view(self, client: viser.ClientHandle, view: str) -> None:
        """Move a client's camera to one of `VIEWS`; with "follow", `follow` will move it."""
        aspect = aspect_of(client.camera)
        self.views[client.client_id] = view, aspect
        picture_view: View | None = next((name for name in VIEWS if name == view), None)
        camera = None if picture_view is None else self._camera(picture_view, aspect)
        if camera is not None:
            with client.atomic():
                client.camera.position, client.camera.look_at = camera

    def follow(self, ball: np.ndarray) -> None:
        """Move the cameras of clients that follow the ball to its position (3,) [m]."""
        for number, client in self._server.get_clients().items():
            if self.views.get(number, ("",))[0] == "follow":
                # Of a client whose camera is invalid, or that has left meanwhile, where warnings are errors.
                with client.atomic(), suppress(ValueError, UserWarning):
                    client.camera.position, client.camera.look_at = ball + FOLLOWED, ball

    def download(self, client: viser.ClientHandle, kind: str, recording: Recording | None, files: Files | None) -> None:
        """Make a file of a recording in a thread of its own, one at a time, and send it to one client."""
        if recording is None or files is None or not self._download_lock.acquire(blocking=False):
            reason = "Kick first." if recording is None else "Another file is being made."
            client.add_notification("Not now", reason, auto_close_seconds=4.0)
            return

        def send() -> None:
            try:
                name, content = files(kind, recording)
                if client.client_id in self._server.get_clients():  # it may have left meanwhile
                    client.send_file_download(name, content, save_immediately=True)
            finally:
                self._download_lock.release()

        threading.Thread(target=send, daemon=True).start()


def aspect_of(camera: viser.CameraHandle) -> float:
    """Return width over height of a client's picture, clipped to a sensible range."""
    return within(camera.aspect, 0.2, 5.0)
