"""A viser server that only its own page can talk to: address, Host, Origin, token, paths and messages are checked.

viser 1.1.1 binds every interface, answers any Host and Origin, reads any file name below its client and decodes any
message. What is served here is one page and one websocket. The checks sit in the websockets server under viser:
viser makes it while it is constructed, and for so long the name it makes it by is ours (:func:`_serving_through`).
"""

from __future__ import annotations

import contextlib
import hmac
import http
import io
import logging
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server as websockets_server
from viser import _messages as viser_messages
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from gausim.core.errors import ConfigError
from gausim.viewer.messages import LARGEST_MESSAGE, MessageChecker, MessageError
from gausim.viewer.pipeline import Rate

if TYPE_CHECKING:
    from websockets.typing import Data

# What the client's build consists of; everything else is not found.
PATHS = ("/", "/index.html")
# Nothing but the page itself: no other origin is asked for anything, and no other page may frame this one.
CONTENT_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob:; worker-src 'self' data: blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
MOST_CLIENTS = 16
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
_MAKING = threading.Lock()
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Door:
    """Where the viewer listens and who may come in.

    Attributes:
        host: address to bind; only a loopback one without ``remote``.
        port: TCP port; 0 takes a free one.
        remote: allow an address that other machines reach; a token is then required.
        names: further host names by which the page may be asked for.
        token: what the first request has to carry (``?token=...``); made up when remote, None: not asked for.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    remote: bool = False
    names: tuple[str, ...] = ()
    token: str | None = None

    def checked(self) -> Door:
        """Returns itself with a token where one is needed.

        Raises:
            ConfigError: the address is no address, others can reach it and ``remote`` is not set, or a value is wrong.
        """
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--port {self.port}: expected 0..65535 (0 takes a free port).")
        try:
            loopback = self.host == "localhost" or ip_address(self.host).is_loopback
        except ValueError as error:
            raise ConfigError(f"--host {self.host!r}: expected an IP address, e.g. 127.0.0.1.") from error
        if not loopback and not self.remote:
            raise ConfigError(
                f"--host {self.host}: other machines could reach the viewer there. Add --allow-remote if they shall "
                "(a token is then required), or go through `ssh -L 8080:127.0.0.1:8080 MACHINE`."
            )
        if self.token is not None and (len(self.token) < 16 or not self.token.isascii() or not self.token.isalnum()):
            raise ConfigError("the token has to be at least 16 letters and digits; leave it out to have one made.")
        needs = not loopback and self.token is None
        return Door(self.host, self.port, self.remote, self.names, secrets.token_hex(24) if needs else self.token)

    def host_names(self) -> frozenset[str]:
        """Names that the header Host may carry; its port may be any, as through a tunnel it is another."""
        names = {"localhost", *(name.lower() for name in self.names)}
        address = None if self.host == "localhost" else ip_address(self.host)
        if address is None or address.is_loopback or address.is_unspecified:
            names |= {"127.0.0.1", "[::1]"}
        if address is not None and address.is_unspecified:
            names.add(socket.gethostname().lower())
        elif address is not None:
            names.add(f"[{address}]" if address.version == 6 else str(address))
        return frozenset(names)


@dataclass
class Traffic:
    """What came and went, over all connections.

    Attributes:
        refused: requests refused, by reason.
        junk: connections closed for a message that the page would not send.
        failed: messages that viser could not make sense of.
        sent: per connection the rate of the messages of at least ``frame_bytes`` that it takes.
        frame_bytes: size from which a message counts as a frame [bytes].
    """

    refused: dict[str, int] = field(default_factory=dict)
    junk: int = 0
    failed: int = 0
    sent: dict[int, Rate] = field(default_factory=dict)
    frame_bytes: int = 1 << 62

    def refuse(self, reason: str) -> None:
        """Counts a refused request."""
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def mishap(self, _: object, context: dict[str, Any]) -> None:
        """Takes note of what a handler of viser raised at a message of the right form and the wrong meaning."""
        self.failed += 1
        _log.info("a message failed: %s", context.get("exception", context.get("message")))

    @property
    def displayed(self) -> float:
        """Frames per second that the quickest connection takes."""
        return max((rate.per_second for rate in list(self.sent.values())), default=0.0)


class GuardedServer(viser.ViserServer):
    """A viser server behind a :class:`Door`.

    Attributes:
        door: the door, with its token.
        traffic: what came and went.
        url: what to open in the browser, with the token where there is one.
    """

    def __init__(self, door: Door, *, label: str = "gausim") -> None:
        """Starts to listen.

        Raises:
            ConfigError: the address cannot be bound, or viser is another version than the one this was written for.
        """
        if viser.__version__ != "1.1.1":
            raise ConfigError(f"viser {viser.__version__}: expected 1.1.1 (`pip install viser==1.1.1`).")
        self.door, self.traffic = door.checked(), Traffic()
        listener = _bind(self.door)
        port = listener.getsockname()[1]
        gate = _Gate(self.door, port, self.traffic)
        with _serving_through(gate, listener), contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host=self.door.host, port=port, label=label, verbose=False)
        loop = self.get_event_loop()
        loop.call_soon_threadsafe(loop.set_exception_handler, self.traffic.mishap)
        self.gui.configure_theme(show_share_button=False, show_logo=False)
        # The button is hidden by the theme; the request behind it would open a tunnel to a public server.
        for kind in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
            self._websock_server.unregister_handler(kind)
        shown = "127.0.0.1" if self.door.host in ("localhost", "0.0.0.0", "::") else self.door.host
        query = f"?token={self.door.token}" if self.door.token else ""
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/{query}"


def _bind(door: Door) -> socket.socket:
    family = socket.AF_INET6 if ":" in door.host else socket.AF_INET
    try:
        return socket.create_server((door.host, door.port), family=family)
    except OSError as error:
        raise ConfigError(
            f"{door.host}:{door.port}: {error.strerror or error}. Choose another --port (0 takes a free one)."
        ) from error


@contextlib.contextmanager
def _serving_through(gate: _Gate, listener: socket.socket) -> Iterator[None]:
    """Within, websockets servers are made with the gate's checks and on the given socket.

    viser's thread makes its server before the constructor returns, so the name needs to be replaced no longer.
    """
    original = websockets_server.serve

    def serve(handler: Callable[[Any], Any], *_: object, process_request: Callable[..., Any], **options: Any) -> Any:
        gate.used = True
        options |= {"max_size": LARGEST_MESSAGE + 1024, "logger": _silent(), "create_connection": gate.connection}
        contained = gate.contain(handler)
        return original(contained, sock=listener, process_request=gate.requests(process_request), **options)

    with _MAKING:
        websockets_server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets_server.serve = original  # type: ignore[misc]
    if not gate.used:
        listener.close()
        raise ConfigError("viser did not start its server through the checks of gausim; expected viser 1.1.1.")


def _silent() -> logging.Logger:
    """Junk must not fill a log with tracebacks."""
    logger = logging.getLogger("gausim.viewer.connections")
    logger.setLevel(logging.CRITICAL)
    return logger


class _Gate:
    """The checks of one server."""

    def __init__(self, door: Door, port: int, traffic: Traffic) -> None:
        self.names, self.token, self.traffic, self.used = door.host_names(), door.token, traffic, False
        self.cookie = f"gausim_{port}"
        self.open: set[ServerConnection] = set()
        gate = self

        class Connection(ServerConnection):
            """A connection whose messages are checked on their way in and counted on their way out."""

            def __init__(self, *arguments: Any, **options: Any) -> None:
                super().__init__(*arguments, **options)
                self.checker = MessageChecker()

            async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
                return self.checker.check(await super().recv(decode))

            async def send(self, message: Any, text: bool | None = None) -> None:
                await super().send(message, text)
                if len(message) >= gate.traffic.frame_bytes:
                    gate.traffic.sent.setdefault(id(self), Rate()).count()

        self.connection = Connection

    def contain(self, handler: Callable[[Any], Any]) -> Callable[[ServerConnection], Any]:
        """The handler of connections, which closes its own one on junk and lets nothing out."""

        async def contained(connection: ServerConnection) -> None:
            self.open.add(connection)
            try:
                await handler(connection)
            except MessageError as error:
                self.traffic.junk += 1
                _log.info("closed a connection: %s", error)
                with contextlib.suppress(ConnectionClosed):
                    await connection.close(1008, "not a message of this page")
            finally:
                self.open.discard(connection)
                self.traffic.sent.pop(id(connection), None)

        return contained

    def requests(self, serve_page: Callable[..., Any]) -> Callable[[ServerConnection, Request], Response | None]:
        """The handler of requests: the checks first, then viser's own."""

        def process(connection: ServerConnection, request: Request) -> Response | None:
            refusal = self._refusal(request)
            if refusal is not None:
                status, reason = refusal
                self.traffic.refuse(reason)
                return _plain(status, f"{reason}\n")
            if self._is_websocket(request):
                return None
            entered = self._enter(request)
            response: Response | None = entered or serve_page(connection, request)
            if response is not None:
                _harden(response.headers)
            return response

        return process

    @staticmethod
    def _is_websocket(request: Request) -> bool:
        return "upgrade" in request.headers

    def _refusal(self, request: Request) -> tuple[http.HTTPStatus, str] | None:
        """Why a request is not answered, or None."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = hosts[0].strip().lower() if len(hosts) == 1 else ""
        match = _HOST.fullmatch(host)
        if match is None or match[1] not in self.names:
            return http.HTTPStatus.MISDIRECTED_REQUEST, "wrong host"
        websocket, own = self._is_websocket(request), (f"http://{host}", f"https://{host}")
        if (websocket and len(origins) != 1) or any(o.strip().lower() not in own for o in origins):
            return http.HTTPStatus.FORBIDDEN, "wrong origin"
        if request.path.partition("?")[0] not in PATHS:
            return http.HTTPStatus.NOT_FOUND, "not found"
        if websocket and len(self.open) >= MOST_CLIENTS:
            return http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients"
        if not self._may_enter(request, websocket):
            return http.HTTPStatus.UNAUTHORIZED, "open the address with ?token=..., as gausim printed it"
        return None

    def _may_enter(self, request: Request, websocket: bool) -> bool:
        if self.token is None:
            return True
        given = self._cookie_of(request)
        if not websocket:
            given = self._query_of(request) or given
        return hmac.compare_digest(given.encode(), self.token.encode())

    def _cookie_of(self, request: Request) -> str:
        jar = SimpleCookie()
        with contextlib.suppress(CookieError):
            for line in request.headers.get_all("Cookie"):
                jar.load(line)
        return jar[self.cookie].value if self.cookie in jar else ""

    @staticmethod
    def _query_of(request: Request) -> str:
        return parse_qs(urlsplit(request.path).query).get("token", [""])[0]

    def _enter(self, request: Request) -> Response | None:
        """Trades the token of the address for a cookie, so that it does not stay in the address bar."""
        if self.token is None or not self._query_of(request):
            return None
        cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return Response(303, "See Other", Headers([("Location", "/"), ("Set-Cookie", cookie), ("Content-Length", "0")]))


def _harden(headers: Headers) -> None:
    headers["Content-Security-Policy"] = CONTENT_POLICY
    headers["X-Content-Type-Options"] = "nosniff"
    headers["X-Frame-Options"] = "DENY"
    headers["Referrer-Policy"] = "no-referrer"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    headers["Cache-Control"] = "no-store"


def _plain(status: http.HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers([("Content-Type", "text/plain; charset=utf-8"), ("Content-Length", str(len(body)))])
    _harden(headers)
    return Response(status.value, status.phrase, headers, body)
