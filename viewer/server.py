"""Server behind the page: its start and end, the requests it admits, and the values that clients may change."""

from __future__ import annotations

import io
import logging
import re
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from errno import EACCES, EADDRINUSE
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any

import msgspec
import viser
import websockets.asyncio.server as listener
from viser import _messages as messages
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from larp_model.errors import InputError
from viewer.checked import has_type_of

RESOLVE_TIMEOUT = 1.5  # s until a host's name must be resolved
CLOSE_TIMEOUT = 0.5  # s for clients to acknowledge that the server closes
LARGEST_MESSAGE = 2**20  # bytes of a client's message; usual ones have a few hundred

# Messages that Viser accepts from clients, for features that no page of this viewer offers.
REFUSED = (
    messages.ShareUrlRequest,
    messages.ShareUrlDisconnect,
    messages.GuiFormSubmitMessage,
    messages.GuiFormDirtyMessage,
    messages.FileTransferStartUpload,
    messages.FileTransferPart,
)

# Example values of the fields that name or place something in a client's message of any kind; see `is_sound`.
FIELDS: dict[str, Any] = {
    **dict.fromkeys(("name", "uuid", "owner"), ""),
    **dict.fromkeys(("position", "look_at", "up_direction"), (0.0, 0.0, 0.0)),
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    **dict.fromkeys(("fov", "near", "far"), 1.0),
}

_STARTING = threading.Lock()
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[^\[\]:]+)(:[0-9]{1,5})?")
_ORIGIN = re.compile(rf"https?://({_HOST.pattern})")
_NAME = re.compile(r"[a-z0-9_-]+(\.[a-z0-9_-]+)*")


def require_address(host: str, port: int, allowed: Sequence[str] = ()) -> None:
    """Raise InputError if `open_server` would; the address is opened for a moment only."""
    _check_names(allowed)
    _listen(host, port).close()


def open_server(host: str = "127.0.0.1", port: int = 8080, allowed: Sequence[str] = ()) -> viser.ViserServer:
    """Return a silent Viser server on exactly this address; port 0 takes a free one.

    It answers only requests for this address that come from its own page or from no page at all. allowed: other names,
    without ports, by which a proxy in front of it is reached, and whose pages may send requests. For a host that other
    machines can reach, a warning is printed on stderr. Raises InputError if the address cannot be opened: Viser itself
    would move to another port, or try for ever.
    """
    proxies = _check_names(allowed)
    listening_socket = _listen(host, port)
    local = is_loopback(listening_socket.getsockname()[0])
    try:
        with redirect_stdout(io.StringIO()):
            server = _Server(host, listening_socket, local, proxies)
    except BaseException:
        listening_socket.close()
        raise
    if not local:
        print(f"host {host}: anyone who reaches this machine can use the page", file=sys.stderr)
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stop a server, without output and within seconds, whatever its clients do."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address_of(server: viser.ViserServer) -> str:
    """Return the URL of the page for a browser on this machine."""
    return f"http://{_bracketed(server.get_host())}:{server.get_port()}"


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach the numeric address."""
    return ip_address(address).is_loopback


def names_of(host: str, local: bool) -> frozenset[str]:
    """Return the host names, without ports, by which a browser may address a server bound to `host`.

    Ports are left out, for forwarding changes them.
    """
    machine_names = ("127.0.0.1", "[::1]") if local else (socket.gethostname(),)
    return frozenset(name.lower() for name in ("localhost", _bracketed(host), *machine_names))


def admits(headers: Headers, names: frozenset[str], addresses: bool, proxies: frozenset[str] = frozenset()) -> bool:
    """Return whether a request is for one of these names and, if a page sent it, comes from this server's own page.

    addresses: whether any IP address is accepted as a name. proxies: names that a request may be for as well, and whose
    pages may send it, for a proxy may put this server's address into the Host header and leave its own in the Origin
    header. To reach this server, the page of another site must be served under a name that its owner resolves first to
    that site and then to this server; that name is not among the accepted ones.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    host = _HOST.fullmatch(hosts[0].lower()) if len(hosts) == 1 else None
    if host is None or not (host[1] in names | proxies or (addresses and _is_address(host[1]))):
        return False
    if not origins:
        return True
    origin = _ORIGIN.fullmatch(origins[0].lower()) if len(origins) == 1 else None
    return origin is not None and (origin[1] == host[0] or origin[2] in proxies)


def is_sound(raw: str | bytes) -> bool:
    """Return whether names in a client's message are text and its places are finite vectors of the right length.

    Viser would put them into its state unchecked. A message that Viser cannot decode at all passes here: Viser then
    drops the sender.
    """
    try:
        message = msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
    except (msgspec.DecodeError, RecursionError, UnicodeError):
        return True
    return not isinstance(message, dict) or all(
        has_type_of(message[name], pattern) for name, pattern in FIELDS.items() if name in message
    )


class _Connection(ServerConnection):
    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that passes `is_sound`; others are dropped."""
        while not is_sound(raw := await super().recv(decode)):
            pass
        return raw


class _Server(viser.ViserServer):
    """Viser server that refuses foreign requests.

    Viser has no hook for this, so during its start `serve` of websockets is replaced by one that adds the checks.
    """

    def __init__(self, host: str, listening_socket: socket.socket, local: bool, proxies: frozenset[str]) -> None:
        """Start the server on a socket.

        listening_socket: bound to the host; `stop` closes it. local: whether only this machine reaches the host.
        proxies: see `admits`.
        """
        names = names_of(host, local)
        self._websocket_serve: listener.serve | None = None
        with _STARTING:
            serve = listener.serve

            def checked_serve(handler: Any, *address: Any, **options: Any) -> listener.serve:
                viser_server = vars(self).get("_websock_server")
                if viser_server is None or viser_server._server_thread is not threading.current_thread():
                    return serve(handler, *address, **options)  # for someone else in this process
                options["process_request"] = _guard(options["process_request"], names, not local, proxies)
                options["create_connection"] = _Connection
                options["max_size"] = LARGEST_MESSAGE
                options["logger"] = logging.Logger("viewer", logging.CRITICAL)  # or strangers write to our terminal
                self._websocket_serve = serve(handler, sock=listening_socket, **options)
                return self._websocket_serve

            listener.serve = checked_serve  # type: ignore[assignment,misc]
            try:
                super().__init__(host, listening_socket.getsockname()[1], verbose=False)
            finally:
                listener.serve = serve  # type: ignore[misc]
        if self._websocket_serve is None:
            self.stop()
            raise RuntimeError(f"Viser {viser.__version__} opens its server in a way that cannot be guarded")
        for kind in REFUSED:
            self._websock_server.unregister_handler(kind)
        self._websock_server.unregister_handler(messages.GuiUpdateMessage)
        self._websock_server.register_handler(messages.GuiUpdateMessage, self._change)

    def stop(self) -> None:
        """Close all connections and end all threads; clients that do not respond are cut off."""
        if self._websocket_serve is not None:
            loop = self._websocket_serve.server.loop
            with suppress(RuntimeError):  # it is closed already
                loop.call_soon_threadsafe(loop.call_later, CLOSE_TIMEOUT, self._cut_off)
        super().stop()

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: there is no public address to request."""

    def disconnect_share_url(self) -> None:
        """Do nothing: there is no public address to give up."""

    def _cut_off(self) -> None:
        assert self._websocket_serve is not None
        for connection in tuple(self._websocket_serve.server.handlers):
            connection.transport.abort()

    async def _change(self, client: Any, message: messages.GuiUpdateMessage) -> None:
        """Apply a client's change of a control's value; drop any other.

        Viser would let a client set any attribute of a control, to anything.
        """
        control = self.gui._gui_input_handle_from_uuid.get(message.uuid)
        if control is None or not isinstance(message.updates, dict) or [*message.updates] != ["value"]:
            return
        if has_type_of(message.updates["value"], control.value):
            await self.gui._handle_gui_updates(client, message)


ProcessRequest = Callable[[ServerConnection, Request], Response | None]


def _guard(
    process_request: ProcessRequest, names: frozenset[str], addresses: bool, proxies: frozenset[str]
) -> ProcessRequest:
    def checked_process_request(connection: ServerConnection, request: Request) -> Response | None:
        if admits(request.headers, names, addresses, proxies):
            return process_request(connection, request)
        refusal = "This page is served only under its own address; --allow-host NAME admits a proxy's.\n"
        return connection.respond(HTTPStatus.FORBIDDEN, refusal)

    return checked_process_request


def _check_names(allowed: Sequence[str]) -> frozenset[str]:
    """Return host names in lower case; raise InputError for anything else, such as one with a port, or a URL."""
    for name in allowed:
        if not _NAME.fullmatch(name.lower()):
            raise InputError(f"allow_host has {name!r}, but needs hosts' names without port, such as hub.example.org")
    return frozenset(name.lower() for name in allowed)


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that already listens at the address, so that nobody can take its port between check and use."""
    if not isinstance(port, int) or not 0 <= port < 2**16:
        raise InputError(f"port is {port!r}, but must be an integer in [0, 65536)")
    try:
        family, address = _resolve(host, port)
        return socket.create_server(address, family=family)
    except OSError as error:
        if error.errno in (EACCES, EADDRINUSE):
            raise InputError(f"port {port} of host {host!r} cannot be opened: {error}; choose another") from None
        raise InputError(f"host is {host!r}, but must be an address or a name of this machine: {error}") from None


def _resolve(host: str, port: int) -> tuple[socket.AddressFamily, Any]:
    """Return family and address of a host, IPv4 if there is one. Raises OSError, also if resolving takes too long."""
    results: list[Any] = []

    def resolve() -> None:
        try:
            results.extend(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM) if host else ())
        except (OSError, ValueError) as error:  # a name can also be malformed
            results.append(error)

    thread = threading.Thread(target=resolve, daemon=True)
    thread.start()
    thread.join(RESOLVE_TIMEOUT)
    if not results or isinstance(results[0], Exception):
        raise OSError(results[0] if results else "nobody knows it")
    family, _, _, _, address = min(results, key=lambda result: result[0] != socket.AF_INET)
    return family, address


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _is_address(name: str) -> bool:
    with suppress(ValueError):
        ip_address(name.removeprefix("[").removesuffix("]"))
        return True
    return False
