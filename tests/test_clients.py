"""Limits of a client of the page: its messages harm neither the page nor other clients."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from page_clients import SOON, change, client, eventually, press, receives, send
from viser import _messages as messages
from websockets.exceptions import ConnectionClosed

from viewer.server import LARGEST_MESSAGE, close_server, open_server


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = open_server(port=0)
    yield server
    close_server(server)


def test_nobody_can_make_the_page_public(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dug: list[object] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *_: dug.append("a tunnel"))
    assert server.request_share_url() is None
    with client(server) as stranger:
        send(stranger, messages.ShareUrlRequest())
        send(stranger, messages.ShareUrlDisconnect())
        press(stranger, server)  # is handled after these
    server._thread_executor.shutdown()  # Viser would dig the tunnel in there
    assert not dug and capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\xc1",
        "a text",
        msgspec.msgpack.encode([1, 2]),
        msgspec.msgpack.encode({"uuid": "x"}),
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode({"type": ["GuiUpdateMessage"]}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "x"}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0]}),
        b"\x91" * 100_000 + b"\xc0",
        bytes(LARGEST_MESSAGE + 1),
    ],
    ids=lambda sent: repr(sent[:40]),
)
def test_a_malformed_message_harms_only_its_sender(
    server: viser.ViserServer, sent: str | bytes, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    text = server.gui.add_markdown("before")
    with client(server) as other, client(server) as stranger:
        stranger.send(sent)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                stranger.recv(timeout=SOON)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == (1009 if len(sent) > LARGEST_MESSAGE else 1011)
        text.content = "hello to others"
        assert receives(other, "hello to others")
        with client(server) as late:
            assert receives(late, "hello to others")
    assert capfd.readouterr() == ("", "") and not caplog.records, "a stranger must not write to our terminal"


@pytest.mark.parametrize(
    "updates",
    [
        {"value": math.nan},
        {"value": math.inf},
        {"value": 1e300},
        {"value": True},
        {"value": "7"},
        {"value": None},
        {"value": [7]},
        {"value": 7, "removed": True},
        {"removed": True},
        {"update_cb": "no list"},
        {"sync_cb": "no function"},
        {"props": {"visible": True}},
        {"no_such": 1},
        {},
    ],
    ids=str,
)
@pytest.mark.parametrize("current", [1, 1.0], ids=["integer", "float"])
def test_a_client_changes_a_value_or_nothing(
    server: viser.ViserServer, updates: dict[str, object], current: float
) -> None:
    slider = server.gui.add_slider("slider", 0, 10, 1, current)
    marker = server.gui.add_slider("marker", 0.0, 1.0, 0.1, 0.0)
    state = vars(slider._impl).copy()
    with client(server) as other, client(server) as stranger:
        change(stranger, slider, **updates)
        change(stranger, marker, value=0.5)
        eventually(lambda: marker.value == 0.5)
        assert vars(slider._impl) == state
        change(stranger, slider, value=7)
        assert receives(other, slider._impl.uuid) and receives(other, slider._impl.uuid), "as created, then changed"
        assert slider.value == 7 and type(slider.value) is type(current)


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [math.nan, 0, 0]},
        {"position": [1, 2]},
        {"position": "123"},
        {"position": ["a"]},
        {"position": None},
        {"wxyz": [1, 0, 0]},
        {"wxyz": [math.inf, 0, 0, 0]},
        {"name": ["/handle"]},
        {"owner": {}},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [messages.TransformControlsUpdateMessage, messages.ViewerCameraMessage])
def test_a_client_puts_handles_and_cameras_at_a_place_or_nowhere(
    server: viser.ViserServer, wrong: dict[str, object], kind: type[messages.Message], caplog: pytest.LogCaptureFixture
) -> None:
    handle = server.scene.add_transform_controls("/handle")
    with client(server) as stranger:
        (its_handle,) = server.get_clients().values()
        pose = {"wxyz": [1, 0, 0, 0], "position": [7, 8, 9]}
        camera = {"look_at": [0, 0, 0], "up_direction": [0, 0, 1], "fov": 1, "near": 1, "far": 2}
        camera |= {"image_height": 9, "image_width": 9}
        handled = {"name": "/handle", "owner": server.scene._owner_id}
        rest = camera if kind is messages.ViewerCameraMessage else handled
        stranger.send(msgspec.msgpack.encode({"type": kind.__name__, **pose, **rest, **wrong}))
        press(stranger, server)
        for placed in (handle, its_handle.camera):
            np.testing.assert_array_equal(placed.position, (0, 0, 0))
            np.testing.assert_array_equal(placed.wxyz, (1, 0, 0, 0))
        stranger.send(msgspec.msgpack.encode({"type": kind.__name__, **pose, **rest}))
        moved = its_handle.camera if kind is messages.ViewerCameraMessage else handle
        eventually(lambda: (moved.position == (7, 8, 9)).all())
    assert not caplog.records


@pytest.mark.parametrize(
    ("add", "value"),
    [
        (lambda gui: gui.add_checkbox("", False), True),
        (lambda gui: gui.add_dropdown("", ("a", "b")), "b"),
        (lambda gui: gui.add_text("", "before"), "after"),
        (lambda gui: gui.add_number("", 1.5), 2),
        (lambda gui: gui.add_vector3("", (0.0, 0.0, 0.0)), (1, 2.5, 3)),
        (lambda gui: gui.add_rgb("", (0, 0, 0)), (1, 2, 3)),
        (lambda gui: gui.add_button_group("", ("a", "b")), "b"),
    ],
)
def test_a_client_can_use_every_control(
    server: viser.ViserServer, add: Callable[[viser.GuiApi], Any], value: object
) -> None:
    control = add(server.gui)
    with client(server) as user:
        change(user, control, value=value)
        eventually(lambda: control.value == value)


def test_what_a_client_says_of_a_form_that_is_none_is_not_kept(server: viser.ViserServer) -> None:
    """Viser keeps it for all clients to come, under any name a client makes up."""
    marker = server.gui.add_slider("marker", 0.0, 1.0, 0.1, 0.0)
    with client(server) as stranger:
        send(stranger, messages.GuiFormDirtyMessage("made up"))
        change(stranger, marker, value=0.5)
        eventually(lambda: marker.value == 0.5)
    stored = server._websock_server._broadcast_buffer.message_from_id.values()
    assert not any(isinstance(message, messages.GuiFormDirtyMessage) for message in stored)
