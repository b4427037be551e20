"""Access control of the viewer: hosts, origins, paths and tokens that are refused, and clients that send rubbish."""

import contextlib
import http.client
from collections.abc import Iterator

import pytest

pytest.importorskip("viser", reason="the extra 'view' is not installed")

import msgspec
import viser
import websockets
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from gausim.core import ConfigError
from gausim.viewer.access import MOST_CLIENTS, Access
from gausim.viewer.server import GuardedServer


@contextlib.contextmanager
def serving(access: Access) -> Iterator[GuardedServer]:
    made = GuardedServer(access)
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture(scope="module")
def server() -> Iterator[GuardedServer]:
    with serving(Access(port=0)) as made:
        yield made


def get(server: GuardedServer, path: str = "/", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    line = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    line.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in ({"Host": f"127.0.0.1:{server.get_port()}"} | headers).items():
        line.putheader(name, value)
    line.endheaders()
    answer = line.getresponse()
    return answer.status, answer.read(), {name.lower(): value for name, value in answer.getheaders()}


def dial(server: GuardedServer, origin: str | None = "", **headers: str) -> ClientConnection:
    """A websocket; the right origin unless another one is given."""
    own = f"http://127.0.0.1:{server.get_port()}"
    return connect(
        own.replace("http", "ws"), origin=None if origin is None else Origin(origin or own),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], additional_headers=headers, compression=None,
    )  # fmt: skip


def alive(server: GuardedServer, **headers: str) -> bool:
    """Whether a new client is welcomed and told something."""
    with dial(server, **headers) as client:
        return len(client.recv(timeout=10)) > 0


def test_serves_its_page_framed_and_shared_by_none_and_through_a_tunnel(server: GuardedServer) -> None:
    status, body, headers = get(server)
    assert status == 200 and b"<title>" in body and alive(server)
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert get(server, Host="localhost:9999", Origin="http://localhost:9999")[0] == 200
    assert get(server, Host="localhost:9999", Origin=f"http://localhost:{server.get_port()}")[0] == 403
    with dial(server) as client:
        client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        assert client.recv(timeout=10) and server._share_tunnel is None


@pytest.mark.parametrize("host", ["evil.example:{port}", "127.0.0.1.evil.example:{port}", "127.0.0.1:{port}@evil", ""])
def test_other_hosts_are_refused(server: GuardedServer, host: str) -> None:
    host = host.format(port=server.get_port())
    assert get(server, Host=host)[0] in (400, 421)
    with pytest.raises((InvalidStatus, ConnectionClosed, websockets.exceptions.InvalidMessage)):
        dial(server, Host=host)  # a second header of the name


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", None, "http://127.0.0.1:{port}.evil.example"]
)
def test_other_origins_get_no_websocket(server: GuardedServer, origin: str | None) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        dial(server, origin.format(port=server.get_port()) if origin else origin)
    if origin:
        assert get(server, Origin=origin.format(port=server.get_port()))[0] == 403


@pytest.mark.parametrize("path", ["/../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/assets/"])
def test_other_paths_are_refused(server: GuardedServer, path: str) -> None:
    assert get(server, path)[:2] == (404, b"not found\n")


@pytest.mark.parametrize(
    "junk", [b"\xdd\xff\xff\xff\xff", "text", msgspec.msgpack.encode({"type": "NoSuchMessage"}), b"\x91" * 100_000]
)
def test_junk_costs_the_sender_its_connection_and_nobody_else(server: GuardedServer, junk: bytes | str) -> None:
    with dial(server) as bystander, dial(server) as client:
        client.send(junk)
        with pytest.raises(ConnectionClosed):
            while True:
                client.recv(timeout=10)
        assert bystander.recv(timeout=10)
        bystander.ping().wait(10)
    assert alive(server)


def test_more_clients_than_are_served_are_turned_away() -> None:
    with serving(Access(port=0)) as server, contextlib.ExitStack() as clients:
        for _ in range(MOST_CLIENTS):
            clients.enter_context(dial(server))
        with pytest.raises(InvalidStatus, match="503"):
            dial(server)


def test_other_machines_are_let_in_only_by_flag_and_token(server: GuardedServer) -> None:
    for wrong in (Access(host="0.0.0.0", port=0), Access(token="short"), Access(token="ümlaute" * 4)):
        with pytest.raises(ConfigError, match="--allow-remote|16 letters"):
            GuardedServer(wrong)
    with pytest.raises(ConfigError, match="--port"):
        GuardedServer(Access(port=server.get_port()))
    with serving(Access(host="0.0.0.0", port=0, remote=True)) as remote:
        token = remote.access.token
        assert token is not None and len(token) >= 32 and token in remote.url
        assert get(remote)[0] == get(remote, "/?token=" + "0" * len(token))[0] == 401
        status, _, headers = get(remote, f"/?token={token}")
        assert status == 303 and headers["location"] == "/"
        assert "HttpOnly" in headers["set-cookie"] and "SameSite=Strict" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert get(remote, Cookie=cookie)[0] == 200 and alive(remote, Cookie=cookie)
        with pytest.raises(InvalidStatus, match="401"):
            dial(remote)
