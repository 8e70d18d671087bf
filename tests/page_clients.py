"""Clients of the page in tests: requests, messages, and waiting for what they lead to."""

import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from viser import _messages as messages
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

PROTOCOL = f"viser-v{viser.__version__}"
UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
    f"Sec-WebSocket-Protocol: {PROTOCOL}",
)
SOON = 5.0  # s; nothing here takes longer


def ask(server: viser.ViserServer, *lines: str) -> socket.socket:
    """Send a request with these headers, in which PORT is the server's."""
    sent = socket.create_connection(("127.0.0.1", server.get_port()), timeout=SOON)
    text = "\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).replace("PORT", str(server.get_port()))
    sent.sendall(text.encode())
    return sent


def answer(server: viser.ViserServer, *lines: str) -> int:
    """The status of the answer to these headers."""
    with ask(server, *lines) as sent:
        return int(sent.recv(64).split()[1])


def client(server: viser.ViserServer) -> ClientConnection:
    """A client that came as a browser does, camera first."""
    connection = connect(
        f"ws://127.0.0.1:{server.get_port()}",
        origin=f"http://127.0.0.1:{server.get_port()}",  # type: ignore[arg-type]
        subprotocols=[Subprotocol(PROTOCOL)],
        compression=None,
        max_size=None,
        proxy=None,
        open_timeout=SOON,
        close_timeout=SOON,
    )
    before = len(server.get_clients())
    send(connection, messages.ViewerCameraMessage((1, 0, 0, 0), (0, 0, 0), 1.0, 0.1, 9.0, 9, 9, (1, 0, 0), (0, 0, 1)))
    eventually(lambda: len(server.get_clients()) > before)
    return connection


def send(speaker: Connection, message: messages.Message) -> None:
    speaker.send(msgspec.msgpack.encode(message.as_serializable_dict()))


def change(speaker: Connection, control: Any, **updates: object) -> None:
    send(speaker, messages.GuiUpdateMessage(control._impl.uuid, updates))


def press(user: Connection, server: viser.ViserServer) -> None:
    """Press a button, and wait until that is answered in a thread of the server."""
    pressed = threading.Event()
    button = server.gui.add_button("press")
    button.on_click(lambda _: pressed.set())
    change(user, button, value=True)
    assert pressed.wait(SOON)


def eventually(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SOON
    while not holds():
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.01)


def receives(listening: Connection, text: str) -> bool:
    """Return whether the client gets a message with this text soon."""
    while True:
        window = listening.recv(timeout=SOON)
        assert isinstance(window, bytes)
        size = int.from_bytes(window[8:16], "little")
        if text.encode() in zstandard.decompress(window[16 : 16 + size], int.from_bytes(window[:8], "little")):
            return True
