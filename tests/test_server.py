"""The server behind the page: who may enter, what a client can do to it and to others, and what it leaves behind."""

import math
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from typing import Any
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest
import viser
import websockets.asyncio.server as listener
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from viser import _messages as messages
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from larp_model.errors import InputError
from viewer.checked import alike, flag, option, vector, within
from viewer.server import LARGEST_MESSAGE, address_of, admits, close_server, names_of, open_server, require_address

PROTOCOL = f"viser-v{viser.__version__}"
UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
    f"Sec-WebSocket-Protocol: {PROTOCOL}",
)
SOON = 5.0  # s; nothing here takes longer

anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.floats()), st.binary(),
    st.sampled_from([10**400, -(10**400), np.float32(0.5), np.array(0.5), np.zeros((3, 2)), np.ones(3), {}, object()]),
)  # fmt: skip


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = open_server(port=0)
    yield server
    close_server(server)


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
    """Whether the client gets a message with this text soon."""
    while True:
        window = listening.recv(timeout=SOON)
        assert isinstance(window, bytes)
        size = int.from_bytes(window[8:16], "little")
        if text.encode() in zstandard.decompress(window[16 : 16 + size], int.from_bytes(window[:8], "little")):
            return True


@pytest.mark.parametrize("upgrade", [(), UPGRADE], ids=["page", "websocket"])
@pytest.mark.parametrize(
    ("host", "origin", "enters"),
    [
        ("127.0.0.1:PORT", None, True),
        ("localhost:PORT", None, True),
        ("[::1]:PORT", None, True),
        ("LOCALHOST:PORT", "http://localhost:PORT", True),
        ("127.0.0.1:9000", "http://127.0.0.1:9000", True),
        ("localhost", "https://localhost", True),
        ("evil.example", None, False),
        ("evil.example:PORT", "http://evil.example:PORT", False),
        ("localhost.evil.example:PORT", None, False),
        ("127.0.0.1.evil.example", None, False),
        ("evil.example@127.0.0.1", None, False),
        ("127.0.0.1:PORT:PORT", None, False),
        ("192.0.2.1:PORT", None, False),
        ("", None, False),
        (None, None, False),
        ("127.0.0.1:PORT\r\nHost: 127.0.0.1:PORT", None, False),
        ("127.0.0.1:PORT", "http://evil.example", False),
        ("127.0.0.1:PORT", "http://127.0.0.1:9000", False),
        ("127.0.0.1:PORT", "http://localhost:PORT", False),
        ("127.0.0.1:PORT", "http://127.0.0.1:PORT.evil.example", False),
        ("127.0.0.1:PORT", "ftp://127.0.0.1:PORT", False),
        ("127.0.0.1:PORT", "null", False),
        ("127.0.0.1:PORT", "", False),
        ("127.0.0.1:PORT", "http://127.0.0.1:PORT\r\nOrigin: http://evil.example", False),
    ],
)
def test_only_the_page_itself_and_what_is_no_page_may_enter(
    server: viser.ViserServer, host: str | None, origin: str | None, enters: bool, upgrade: Sequence[str]
) -> None:
    lines = [f"{name}: {value}" for name, value in (("Host", host), ("Origin", origin)) if value is not None]
    assert answer(server, *lines, *upgrade) == ((101 if upgrade else 200) if enters else 403)


@pytest.mark.parametrize(
    ("host", "enters"),
    [
        ("192.168.0.7:8080", True),
        ("[2001:db8::1]:8080", True),
        ("localhost:9000", True),
        (f"{socket.gethostname()}:8080", True),
        ("simulator.example:8080", True),
        ("evil.example:8080", False),
        ("192.168.0.7.evil.example", False),
        ("192.168.0:8080", False),
    ],
)
def test_a_server_for_others_is_asked_by_an_address_or_by_its_own_name(host: str, enters: bool) -> None:
    names = names_of("simulator.example", local=False)
    assert admits(Headers(Host=host), names, addresses=True) is enters
    assert admits(Headers(Host=host, Origin=f"http://{host}"), names, addresses=True) is enters
    assert not admits(Headers(Host=host, Origin="http://192.168.0.8:8080"), names, addresses=True)


def test_a_server_for_others_says_so_once_on_stderr(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("viewer.server.is_loopback", lambda address: False)
    server = open_server(port=0)
    assert [answer(server, f"Host: {host}") for host in ("192.0.2.1", "evil.example")] == [200, 403]
    close_server(server)
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == "host 127.0.0.1: anyone who reaches this machine can use the page\n"


def test_page_answers_on_this_machine_only(server: viser.ViserServer) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", address_of(server))
    with urlopen(address_of(server), timeout=SOON) as page:
        assert b"<html" in page.read().lower()
    with pytest.raises(OSError):  # a page on all addresses would answer on this one too
        socket.create_connection(("127.0.0.2", server.get_port()), timeout=1).close()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.2", "::1"])
def test_the_address_that_is_told_opens_the_page(host: str, capsys: pytest.CaptureFixture) -> None:
    try:
        server = open_server(host, 0)
    except ValueError:
        assert host == "::1", "this machine may have no IPv6"
        pytest.skip("no IPv6 here")
    try:
        with urlopen(address_of(server), timeout=SOON) as page:
            assert page.status == 200
    finally:
        close_server(server)
    assert capsys.readouterr() == ("", "")


def test_other_servers_of_viser_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those made afterwards, and those that another thread makes while ours starts."""
    serve, others = listener.serve, []

    def elsewhere() -> None:
        monkeypatch.undo()
        making = threading.Thread(target=lambda: others.append(viser.ViserServer("127.0.0.1", 0, verbose=False)))
        making.start()
        making.join(SOON)

    monkeypatch.setattr("viser._client_autobuild.ensure_client_is_built", elsewhere)
    ours = open_server(port=0)
    assert listener.serve is serve
    others.append(viser.ViserServer("127.0.0.1", 0, verbose=False))
    assert len(others) == 2
    assert answer(ours, "Host: evil.example") == 403
    assert [answer(other, "Host: evil.example") for other in others] == [200, 200]
    for other in (ours, *others):
        close_server(other)


def test_a_server_that_cannot_be_guarded_does_not_stay_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when another Viser asks for its listener elsewhere."""
    before, serve = set(threading.enumerate()), listener.serve

    class Hidden:
        asyncio = type("", (), {"server": type("", (), {"serve": serve, "ServerConnection": object})})

    monkeypatch.setattr("viser.infra._infra.websockets", Hidden)
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        open_server(port=0)
    eventually(lambda: set(threading.enumerate()) <= before)
    assert listener.serve is serve


@pytest.mark.parametrize("taken_by", [open_server, lambda host, port: socket.create_server((host, port))])
def test_a_busy_port_is_named(taken_by: Callable[[str, int], Any]) -> None:
    with ExitStack() as stack:
        taken = taken_by("127.0.0.1", 0)
        if isinstance(taken, socket.socket):
            port = stack.enter_context(taken).getsockname()[1]
        else:
            port = taken.get_port()
            stack.callback(close_server, taken)
        with pytest.raises(InputError, match=f"^port {port} of host '127.0.0.1' cannot be opened.*choose") as caught:
            open_server(port=port)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("host", ["192.0.2.1", "2001:db8::1", "no-such-host.invalid", "", "a b", "a..b", "x" * 64])
def test_an_impossible_host_is_named_soon(host: str) -> None:
    """The addresses are reserved for documentation, the name for what does not exist: no machine has them."""
    began = time.monotonic()
    with pytest.raises(InputError, match=f"^host is {host!r}, but must be an address or a name") as caught:
        open_server(host, 0)
    assert time.monotonic() - began < 2.0 and "\n" not in str(caught.value)


def test_a_host_that_nobody_answers_for_is_named_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = threading.Event()
    monkeypatch.setattr("socket.getaddrinfo", lambda *_, **__: answered.wait(SOON) and [])
    began = time.monotonic()
    with pytest.raises(InputError, match=r"^host is 'slow\.example', .*: nobody knows it$"):
        open_server("slow.example", 0)
    assert time.monotonic() - began < 2.0
    answered.set()


@pytest.mark.parametrize("port", [-1, 65536, 80.0, "80"])
def test_an_impossible_port_is_named(port: Any) -> None:
    with pytest.raises(InputError, match=f"^port is {port!r}, but must be an integer in"):
        open_server(port=port)


def test_nobody_can_make_the_page_public(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
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
    server: viser.ViserServer, sent: str | bytes, capfd: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
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


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="open files cannot be counted here")
def test_nothing_is_left_of_closed_servers(capfd: pytest.CaptureFixture) -> None:
    """Neither threads nor sockets nor event loops; also where clients have called back, or do not answer."""
    close_server(open_server(port=0))  # what is imported late is no leak
    threads, files = set(threading.enumerate()), len(os.listdir("/proc/self/fd"))
    servers = [open_server(port=0) for _ in range(3)]
    assert len(set(threading.enumerate()) - threads) == 3 and len(os.listdir("/proc/self/fd")) > files
    with ExitStack() as stack:
        for server in servers:
            press(stack.enter_context(client(server)), server)
        silent, deaf = ask(servers[0]), ask(servers[0], "Host: localhost", *UPGRADE)
        stack.enter_context(closing(silent))
        stack.enter_context(closing(deaf))
        half = stack.enter_context(socket.create_connection(("127.0.0.1", servers[1].get_port()), timeout=SOON))
        half.sendall(b"GET / HTTP/1.1\r\n")
        assert deaf.recv(12) == b"HTTP/1.1 101"
        for server in servers:
            began = time.monotonic()
            close_server(server)
            close_server(server)  # once more changes nothing
            assert time.monotonic() - began < 2.0
            assert server._event_loop.is_closed()
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.1", server.get_port()), timeout=SOON).close()
    eventually(lambda: set(threading.enumerate()) <= threads)
    eventually(lambda: len(os.listdir("/proc/self/fd")) <= files)
    assert capfd.readouterr() == ("", "")


@given(anything, st.floats(-1e6, 1e6), st.floats(0.0, 1e6))
@example(math.nan, 0.5, 1.5)
@example(math.inf, 0.5, 1.5)
def test_a_number_lies_within_its_bounds(value: object, low: float, width: float) -> None:
    number = within(value, low, low + width)
    assert isinstance(number, float) and low <= number <= low + width
    if isinstance(value, float) and low <= value <= low + width:
        assert number == value
    if not isinstance(value, int | np.floating) and not (isinstance(value, float) and math.isfinite(value)):
        assert number == low


@pytest.mark.parametrize(("value", "expected"), [(3, 2.0), (-1, 0.5), (1, 1.0), (10**400, 2.0), (-math.inf, 0.5)])
def test_a_number_out_of_bounds_goes_to_the_nearest(value: float, expected: float) -> None:
    assert within(value, 0.5, 2.0) == expected


@given(st.one_of(anything, st.lists(anything, min_size=3, max_size=3)))
def test_a_vector_lies_in_its_box(value: object) -> None:
    low, high = (-1.0, 0.0, 2.0), (1.0, 0.5, 2.0)
    inside = vector(value, low, high)
    assert inside.shape == (3,) and inside.dtype == float
    assert (inside >= low).all() and (inside <= high).all()
    parts = value if isinstance(value, list) and len(value) == 3 else low
    if not isinstance(value, np.ndarray):
        np.testing.assert_array_equal(inside, [within(*part) for part in zip(parts, low, high, strict=True)])


@pytest.mark.parametrize("kind", [tuple, list, np.array])
def test_a_vector_in_its_box_is_kept(kind: Callable[[Any], object]) -> None:
    np.testing.assert_array_equal(vector(kind((0.5, -9.0, 9.0)), (-1, -1, -1), (1, 1, 1)), (0.5, -1.0, 1.0))


@given(anything, st.lists(st.text(), min_size=1))
def test_an_option_is_one_of_those_offered(value: object, offered: list[str]) -> None:
    assert option(value, offered) == (value if isinstance(value, str) and value in offered else offered[0])
    assert all(option(text, offered) == text for text in offered)


@given(anything)
def test_a_flag_is_true_only_where_it_is_true(value: object) -> None:
    assert flag(value) is (isinstance(value, bool) and value)


@given(anything, st.sampled_from([True, 1, 1.0, "text", (0.0, 0.0), (), None]))
def test_what_may_stand_for_a_value_is_of_its_kind_and_can_be_sent_to_all(value: object, current: object) -> None:
    kinds = {bool: bool, int: (int, float), float: (int, float), str: str, tuple: list}
    if alike(value, current):
        assert isinstance(value, kinds[type(current)])  # type: ignore[arg-type]
        msgspec.msgpack.encode(int(value) if type(current) is int else value)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("value", "current"), [(False, True), (2.5, 1), (2, 1.0), ("", "text"), ([1, 2.5], (0.0, 0.0)), ([], ())]
)
def test_what_a_browser_sends_of_a_control_may_stand_for_its_value(value: object, current: object) -> None:
    assert alike(value, current)


@pytest.mark.parametrize(
    ("host", "origin", "enters"),
    [
        ("hub.example:8000", "https://hub.example:8000", True),
        ("127.0.0.1:8080", "https://hub.example", True),
        ("HUB.example", None, True),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("127.0.0.1:8080", "https://hub.example.evil.example", False),
        ("127.0.0.1:8080", "https://evil.example", False),
        ("evil.example", "https://hub.example", False),
        ("evil.example", None, False),
    ],
)
def test_a_proxy_that_is_named_may_ask_and_so_may_its_pages(host: str, origin: str | None, enters: bool) -> None:
    names, headers = names_of("127.0.0.1", local=True), Headers(Host=host)
    if origin is not None:
        headers["Origin"] = origin
    assert admits(headers, names, addresses=False, proxies=frozenset({"hub.example"})) is enters
    if "hub.example" in host.lower() or origin == "https://hub.example":
        assert not admits(headers, names, addresses=False), "it must be named"


def test_a_server_behind_a_proxy_answers_it() -> None:
    server = open_server(port=0, allowed=("Hub.example",))
    try:
        assert answer(server, "Host: 127.0.0.1:PORT", "Origin: https://hub.example", *UPGRADE) == 101
        assert answer(server, "Host: 127.0.0.1:PORT", "Origin: https://evil.example", *UPGRADE) == 403
    finally:
        close_server(server)


def test_an_address_that_is_free_stays_free_after_it_was_asked_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port}"):
            require_address("127.0.0.1", port)
    require_address("127.0.0.1", port)
    close_server(open_server("127.0.0.1", port))
