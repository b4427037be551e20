"""Access control of the viewer: checks of address, Host, Origin, token and path."""

from __future__ import annotations

import contextlib
import hmac
import re
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from gausim.core.errors import ConfigError

# Paths of the client's build; all others are answered by 404.
PATHS = ("/", "/index.html")
# No requests to other origins, and no other page may frame this one.
CONTENT_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob:; worker-src 'self' data: blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_HEADERS = {
    "Content-Security-Policy": CONTENT_POLICY, "X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer", "Cross-Origin-Resource-Policy": "same-origin", "Cache-Control": "no-store",
}  # fmt: skip
MOST_CLIENTS = 16
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")


@dataclass(frozen=True)
class Access:
    """Address and access settings of the viewer."""

    host: str = "127.0.0.1"  # address to bind; without ``remote`` a loopback address
    port: int = 8080  # TCP port; 0 takes a free one
    remote: bool = False  # allow addresses that other machines can reach; a token is then required
    names: tuple[str, ...] = ()  # further host names of the page
    # token of the first request (``?token=...``); generated for remote addresses; None: not required
    token: str | None = None

    def checked(self) -> Access:
        """Returns the settings, with a generated token where one is required.

        Raises:
            ConfigError: address, port or token is invalid, or other machines can reach it and ``remote`` is not set.
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
        return self if loopback or self.token is not None else replace(self, token=secrets.token_hex(24))

    def host_names(self) -> set[str]:
        """Allowed names in the header Host; any port is allowed, as a tunnel changes it."""
        address = ip_address("127.0.0.1" if self.host == "localhost" else self.host)
        names = {"localhost", *map(str.lower, self.names), f"[{address}]" if address.version == 6 else str(address)}
        if address.is_loopback or address.is_unspecified:
            names |= {"127.0.0.1", "[::1]"}
        return names | ({socket.gethostname().lower()} if address.is_unspecified else set())


def answer(
    access: Access, cookie: str, serve_page: Callable[..., Any], connection: ServerConnection, request: Request
) -> Response | None:
    """The answer to a request: a refusal, a cookie in exchange for a token, viser's page, or None for a websocket."""
    websocket = "upgrade" in request.headers
    # A cookie replaces the token, so that the token does not stay in the address bar.
    given = "" if websocket else parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    refusal = _refusal(access, given or _cookie(request, cookie), connection, request)
    if refusal is not None:
        response: Response = connection.respond(refusal[0], f"{refusal[1]}\n")
    elif websocket:
        return None
    elif access.token is not None and given:
        response = connection.respond(303, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = f"{cookie}={access.token}; HttpOnly; SameSite=Strict; Path=/"
    else:
        response = serve_page(connection, request)
    for name, value in _HEADERS.items():
        response.headers[name] = value
    return response


def _refusal(access: Access, token: str, connection: ServerConnection, request: Request) -> tuple[int, str] | None:
    """Status and reason of a refused request; None for an accepted one."""
    websocket, headers = "upgrade" in request.headers, request.headers
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    host = hosts[0].strip().lower() if len(hosts) == 1 else ""
    match = _HOST.fullmatch(host)
    if match is None or match[1] not in access.host_names():
        return 421, "wrong host"
    own = (f"http://{host}", f"https://{host}")
    if (websocket and len(origins) != 1) or any(o.strip().lower() not in own for o in origins):
        return 403, "wrong origin"
    if request.path.partition("?")[0] not in PATHS:
        return 404, "not found"
    if websocket and len(connection.server.connections) >= MOST_CLIENTS:
        return 503, "too many clients"
    if access.token is not None and not hmac.compare_digest(token.encode(), access.token.encode()):
        return 401, "open the address with ?token=..., as gausim printed it"
    return None


def _cookie(request: Request, name: str) -> str:
    jar = SimpleCookie()
    with contextlib.suppress(CookieError):
        for line in request.headers.get_all("Cookie"):
            jar.load(line)
    return jar[name].value if name in jar else ""
