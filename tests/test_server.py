"""The server behind the page: who may enter, where it listens, and what it leaves behind."""

import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from typing import Any
from urllib.request import urlopen

import pytest
import viser
import websockets.asyncio.server as listener
from page_clients import SOON, UPGRADE, answer, ask, client, eventually, press
from websockets.datastructures import Headers

from larp_model.errors import InputError
from viewer.server import address_of, admits, close_server, names_of, open_server, require_address


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = open_server(port=0)
    yield server
    close_server(server)


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
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
def test_the_address_that_is_told_opens_the_page(host: str, capsys: pytest.CaptureFixture[str]) -> None:
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


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="open files cannot be counted here")
def test_nothing_is_left_of_closed_servers(capfd: pytest.CaptureFixture[str]) -> None:
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
