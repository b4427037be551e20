"""Access to the viewer: its address, and the check of Host, Origin, path and token of every request."""

import hmac
import re
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from gausim.core.errors import ConfigError

MOST_CLIENTS = 16
# No requests to other origins, and no other page may frame this one.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
}  # fmt: skip
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")


@dataclass(frozen=True)
class Access:
    """Address and access settings of the viewer."""

    host: str = "127.0.0.1"  # address to bind; without ``remote`` a loopback address
    port: int = 8080  # TCP port; 0 takes a free one
    remote: bool = False  # allow addresses that other machines can reach; a token is then required
    names: tuple[str, ...] = ()  # further host names of the page
    token: str | None = None  # of the first request (``?token=...``); made for remote addresses; None: not required

    def checked(self) -> "Access":
        """Returns the settings, with a generated token where one is required.

        Raises:
            ConfigError: the token is invalid, or other machines can reach the address and ``remote`` is not set.
        """
        loopback = self.host in ("localhost", "127.0.0.1", "::1")
        if not loopback and not self.remote:
            raise ConfigError(f"--host {self.host}: other machines could reach it. Add --allow-remote if they shall.")
        if self.token is not None and (len(self.token) < 16 or not self.token.isascii() or not self.token.isalnum()):
            raise ConfigError("the token has to be at least 16 letters and digits; leave it out to have one made.")
        return self if loopback or self.token is not None else replace(self, token=secrets.token_hex(24))


def answer(
    access: Access, cookie: str, serve_page: Callable[..., Any], connection: ServerConnection, request: Request
) -> Response | None:
    """The answer to a request: a refusal, a cookie in exchange for a token, viser's page, or None for a websocket."""
    websocket = "upgrade" in request.headers
    # A cookie replaces the token, so that the token does not stay in the address bar.
    given = "" if websocket else parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    known = re.search(rf"(?:^|;\s*){cookie}=([^;]*)", "; ".join(request.headers.get_all("Cookie")))
    refusal = _refusal(access, given or (known[1] if known else ""), connection, request)
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
    response.headers.update(_HEADERS)
    return response


def _refusal(access: Access, token: str, connection: ServerConnection, request: Request) -> tuple[int, str] | None:
    """Status and reason of a refused request; None for an accepted one."""
    websocket, headers = "upgrade" in request.headers, request.headers
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    host = hosts[0].strip().lower() if len(hosts) == 1 else ""
    match, address = _HOST.fullmatch(host), f"[{access.host}]" if ":" in access.host else access.host
    # Any port is allowed, as a tunnel changes it.
    allowed = {"localhost", "127.0.0.1", "[::1]", socket.gethostname(), address, *access.names}
    if match is None or match[1] not in map(str.lower, allowed):
        return 421, "wrong host"
    if (websocket and len(origins) != 1) or any(o not in (f"http://{host}", f"https://{host}") for o in origins):
        return 403, "wrong origin"
    if request.path.partition("?")[0] not in ("/", "/index.html"):
        return 404, "not found"
    if websocket and len(connection.server.connections) >= MOST_CLIENTS:
        return 503, "too many clients"
    if access.token is not None and not hmac.compare_digest(token.encode(), access.token.encode()):
        return 401, "open the address with ?token=..., as gausim printed it"
    return None
