"""Access control: wrong hosts and origins, paths, tokens, invalid messages; and clients that are slow or too many."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http.client
import os
import random
import resource
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the extra 'view' is not installed")

import msgspec
import viser
import websockets
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from gausim.core import ConfigError
from gausim.interaction.interaction import Interaction
from gausim.interaction.session import Wind
from gausim.viewer.access import CONTENT_POLICY, MOST_CLIENTS, Access
from gausim.viewer.app import Subject, Viewer
from gausim.viewer.server import GuardedServer

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, -5, 0.5], "fov": 0.8, "near": 0.1, "far": 100,
    "image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip


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
    """A websocket; the right origin unless told."""
    own = f"http://127.0.0.1:{server.get_port()}"
    return connect(
        own.replace("http", "ws"), origin=None if origin is None else Origin(origin or own), subprotocols=[PROTOCOL],
        additional_headers=headers, compression=None, open_timeout=10,
    )  # fmt: skip


def alive(server: GuardedServer, **headers: str) -> bool:
    """Whether a new client is welcomed and told something."""
    with dial(server, **headers) as client:
        client.send(msgspec.msgpack.encode(CAMERA))
        return len(client.recv(timeout=10)) > 0


def test_listens_on_loopback_alone_and_serves_its_page(server: GuardedServer) -> None:
    status, body, headers = get(server)
    assert status == 200 and b"<title>" in body
    assert headers["content-security-policy"] == CONTENT_POLICY and "frame-ancestors 'none'" in CONTENT_POLICY
    assert headers["x-content-type-options"] == "nosniff"
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for address in [a for a in others if not str(a).startswith("127.")]:
        with pytest.raises(OSError):
            socket.create_connection((str(address), server.get_port()), timeout=2).close()


@pytest.mark.parametrize(
    "host", ["evil.example:{port}", "127.0.0.1.evil.example:{port}", "127.0.0.1:{port}@evil", "", "0"]
)
def test_evil_hosts_are_refused(server: GuardedServer, host: str) -> None:
    host = host.format(port=server.get_port())
    assert get(server, Host=host)[0] in (400, 421)
    with pytest.raises((InvalidStatus, ConnectionClosed, websockets.exceptions.InvalidMessage)):
        dial(server, Host=host)  # a second header of the name


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://127.0.0.1:1", None, "http://127.0.0.1:{port}.evil.example"],
)  # fmt: skip
def test_evil_origins_get_no_websocket(server: GuardedServer, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as caught:
        dial(server, origin.format(port=server.get_port()) if origin else origin)
    assert caught.value.response.status_code == 403
    if origin:
        assert get(server, Origin=origin.format(port=server.get_port()))[0] == 403
    assert alive(server)


def test_a_tunnel_with_another_port_may_come_in(server: GuardedServer) -> None:
    assert get(server, Host="localhost:9999")[0] == 200
    assert get(server, Host="localhost:9999", Origin="http://localhost:9999")[0] == 200
    assert get(server, Host="localhost:9999", Origin=f"http://localhost:{server.get_port()}")[0] == 403


@pytest.mark.parametrize(
    "path",
    ["/../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "/..%2f..%2fetc/passwd", "//etc/passwd",
     "/index.html/../../__init__.py", "file:///etc/passwd", "/assets/"],
)  # fmt: skip
def test_path_traversal_is_refused(server: GuardedServer, path: str) -> None:
    status, body, _ = get(server, path)
    assert status == 404 and body == b"not found\n"


def junk(number: int) -> bytes | str:
    """Rubbish of many kinds, from truncated bytes to well-formed messages with evil contents."""
    choice = random.Random(number)
    uuid = "".join(choice.choices("abcdef0123456789", k=8))
    encode = msgspec.msgpack.encode
    kinds: list[Callable[[], bytes | str]] = [
        lambda: choice.randbytes(choice.randint(0, 200)),
        lambda: "text " + uuid,
        lambda: encode([1, 2, 3]),
        lambda: encode({"type": "NoSuchMessage", "uuid": uuid}),
        lambda: encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"update_cb": [uuid]}}),
        lambda: encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": float("nan")}}),
        lambda: encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": "1e999"}}),
        lambda: encode({"type": "ShareUrlRequest"}),
        lambda: encode(CAMERA | {"position": [0, float("inf"), 0]}),
        lambda: encode(CAMERA | {"wxyz": [1, 2]}),
        lambda: encode(CAMERA | {"extra": 1}),
        lambda: encode({"type": "FileTransferPart", "source_component_uuid": uuid, "transfer_uuid": uuid,
                        "part_index": 0, "content": b"x" * 1000}),
        lambda: encode({"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": uuid,
                        "filename": "../../x", "mime_type": "", "part_count": 10**6, "size_bytes": 1 << 40}),
        lambda: encode({"type": "RunJavascriptMessage", "source": "alert(1)"}),
        lambda: b"\x91" * 100_000,
        lambda: b"\xdd\xff\xff\xff\xff",
    ]  # fmt: skip
    return kinds[number % len(kinds)]()


def offend(server: GuardedServer, count: int) -> int:
    """Sends junk, several messages a connection, and dials again whenever it is thrown out."""
    thrown = sent = 0
    while sent < count:
        with dial(server) as client:
            try:
                for _ in range(4):
                    sent += 1
                    client.send(junk(sent))
                while True:
                    client.recv(timeout=10)
            except ConnectionClosed:
                thrown += 1
    return thrown


def test_junk_costs_the_sender_its_connection_and_nobody_else(server: GuardedServer) -> None:
    offend(server, 16)  # what is imported or cached once
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with dial(server) as bystander:
        bystander.send(msgspec.msgpack.encode(CAMERA))
        assert bystander.recv(timeout=10)
        thrown = offend(server, 200)
        assert thrown >= 50 and server.junk >= thrown
        server.gui.add_markdown("still here")
        assert bystander.recv(timeout=10), "the bystander was thrown out too"
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / before - 1
    assert alive(server) and grown < 0.05, f"memory grew by {grown:.1%}"


def refused(server: GuardedServer, *messages: dict) -> bool:
    """Whether a client that says all this is thrown out."""
    with dial(server) as client, contextlib.suppress(TimeoutError):
        for message in messages:
            client.send(msgspec.msgpack.encode(message))
        try:
            while True:
                client.recv(timeout=10)
        except ConnectionClosed:
            return True
    return False


def test_no_client_can_have_the_page_shared_or_upload_without_end(server: GuardedServer) -> None:
    handlers = server._websock_server._incoming_handlers
    assert not {kind.__name__ for kind in handlers} & {"ShareUrlRequest", "ShareUrlDisconnect"}
    assert refused(server, {"type": "ShareUrlRequest"}) and server._share_tunnel is None
    start = {"type": "FileTransferStartUpload", "source_component_uuid": "x", "filename": "a", "mime_type": "",
             "part_count": 2, "size_bytes": 10}  # fmt: skip
    assert refused(server, *(start | {"transfer_uuid": str(number)} for number in range(3)))


def test_more_clients_than_are_served_are_turned_away() -> None:
    with serving(Access(port=0)) as server:
        clients = [dial(server) for _ in range(MOST_CLIENTS)]
        with pytest.raises(InvalidStatus, match="503"):
            dial(server)
        for client in clients:
            client.close()
        assert alive(server)


def test_other_machines_are_let_in_only_by_flag_and_token() -> None:
    with pytest.raises(ConfigError, match="--allow-remote"):
        GuardedServer(Access(host="0.0.0.0", port=0))
    with pytest.raises(ConfigError, match="IP address"):
        GuardedServer(Access(host="example.org", port=0, remote=True))
    with serving(Access(host="0.0.0.0", port=0, remote=True)) as server:
        token = server.access.token
        assert token is not None and len(token) >= 32 and token in server.url
        assert get(server)[0] == 401
        assert get(server, "/?token=" + "0" * len(token))[0] == 401
        status, _, headers = get(server, f"/?token={token}")
        assert status == 303 and headers["location"] == "/"
        assert "HttpOnly" in headers["set-cookie"] and "SameSite=Strict" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert get(server, Cookie=cookie)[0] == 200
        with pytest.raises(InvalidStatus, match="401"):
            dial(server)
        assert alive(server, Cookie=cookie)


@pytest.mark.parametrize("token", ["short", "has spaces in its middle", "ümlaute" * 4])
def test_weak_tokens_are_refused(token: str) -> None:
    with pytest.raises(ConfigError, match="16 letters"):
        Access(token=token).checked()


def test_a_port_in_use_is_said(server: GuardedServer) -> None:
    with pytest.raises(ConfigError, match="--port"):
        GuardedServer(Access(port=server.get_port()))


async def _watch(url: str, ends: float, pause: float) -> int:
    """A client that takes a message every ``pause`` seconds, moves its camera and dials again when thrown out."""
    taken = 0
    while time.monotonic() < ends:
        # One that is far behind answers no ping, and is thrown out for it.
        with contextlib.suppress(ConnectionClosed):
            async with connect_async(
                url.replace("http", "ws"), origin=Origin(url.rstrip("/")), subprotocols=[PROTOCOL], compression=None,
                max_size=None, max_queue=2, ping_interval=None, close_timeout=1,
            ) as client:  # fmt: skip
                while time.monotonic() < ends:
                    await client.send(msgspec.msgpack.encode(CAMERA))
                    await asyncio.wait_for(client.recv(), 30)
                    taken += 1
                    await asyncio.sleep(pause)
    return taken


@pytest.mark.slow
def test_several_clients_also_slow_ones_cost_no_memory(make_interaction: Callable[..., Interaction]) -> None:
    seconds = float(os.environ.get("GAUSIM_TEST_CLIENT_SECONDS", "40"))
    viewer = Viewer(Subject("a column", make_interaction()), Access(port=0))
    viewer.start()
    viewer.live.do(lambda: viewer.live.act(Wind((1.0, 0.0, 0.0), 1.0, gusts=0.5)))  # frames differ, all are sent

    async def memory(ends: float) -> list[int]:
        await asyncio.sleep(min(20.0, seconds / 2))  # caches and the timeline of the simulation fill
        sizes = []
        while time.monotonic() < ends:
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
            await asyncio.sleep(2.0)
        return sizes

    async def all_of_them(ends: float) -> list:
        return await asyncio.gather(memory(ends), *(_watch(viewer.url, ends, pause) for pause in (0.0, 0.02, 0.5, 3.0)))

    try:
        sizes, *taken = asyncio.run(all_of_them(time.monotonic() + seconds))
        half = len(sizes) // 2
        grown = max(sizes[half:]) / max(sizes[: max(1, half // 4)]) - 1
        assert all(taken) and grown < 0.05, f"memory grew by {grown:.1%}, taken {taken}"
        assert not viewer.live.message and all(w.failures == 0 for w in viewer.workers)
    finally:
        viewer.stop()
