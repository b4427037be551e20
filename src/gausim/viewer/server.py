"""A viser server with access control, which communicates with its own page only.

viser 1.1.1 binds every interface, answers any Host and Origin, reads any file below its client and decodes any message.
This server offers one page and one websocket. The checks are in the underlying websockets server, which viser creates
by calling ``serve`` in its constructor; that function is replaced during the construction.
"""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from viser import _messages as viser_messages
from websockets.asyncio.server import ServerConnection

from gausim.core.errors import ConfigError
from gausim.viewer.access import Access, answer
from gausim.viewer.messages import LARGEST_MESSAGE, MessageChecker, MessageError
from gausim.viewer.pipeline import Rate

# Invalid messages must not fill a log with tracebacks.
_silent = logging.getLogger("gausim.viewer.connections")
_silent.setLevel(logging.CRITICAL)


class _Connection(ServerConnection):
    """A connection that validates received messages and counts sent frames."""

    def __init__(self, guarded: GuardedServer, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._guarded, self._checker = guarded, MessageChecker()

    async def recv(self, decode: bool | None = None) -> Any:
        try:
            return self._checker.check(await super().recv(decode))
        except MessageError:
            self._guarded.junk += 1
            await self.close(1008, "not a message of this page")
            raise self.protocol.close_exc from None

    async def send(self, message: Any, text: bool | None = None) -> None:
        await super().send(message, text)
        if len(message) >= self._guarded.frame_bytes:
            self._guarded.sent.setdefault(id(self), Rate()).count()

    def connection_lost(self, exc: Exception | None) -> None:
        self._guarded.sent.pop(id(self), None)
        super().connection_lost(exc)


class GuardedServer(viser.ViserServer):
    """A viser server with access control by :class:`Access`.

    Attributes:
        access: the access settings, with the token.
        url: address of the page, with the token if there is one.
        junk: number of connections closed for invalid messages.
        failed: number of messages for which a handler of viser raised an error.
        sent: rate of sent messages of at least ``frame_bytes`` [bytes], per connection.
    """

    def __init__(self, access: Access, *, label: str = "gausim") -> None:
        """Starts to listen.

        Raises:
            ConfigError: the address cannot be bound, or viser has another version than 1.1.1.
        """
        if viser.__version__ != "1.1.1":
            raise ConfigError(f"viser {viser.__version__}: expected 1.1.1 (`pip install viser==1.1.1`).")
        self.access, self.sent = access.checked(), dict[int, Rate]()
        self.junk, self.failed, self.frame_bytes = 0, 0, 1 << 62
        try:
            family = socket.AF_INET6 if ":" in access.host else socket.AF_INET
            listener = socket.create_server((access.host, access.port), family=family)
        except OSError as error:
            where = f"{access.host}:{access.port}: {error.strerror or error}"
            raise ConfigError(f"{where}. Choose another --port (0 takes a free one).") from error
        port, original = listener.getsockname()[1], websockets_server.serve

        def serve(handler: Any, *_: object, process_request: Callable[..., Any], **options: Any) -> Any:
            options |= {"max_size": LARGEST_MESSAGE + 1024, "logger": _silent, "sock": listener}
            options["process_request"] = partial(answer, self.access, f"gausim_{port}", process_request)
            options["create_connection"] = partial(_Connection, self)
            return original(handler, **options)

        try:
            websockets_server.serve = serve  # type: ignore[assignment, misc]
            with contextlib.redirect_stdout(io.StringIO()):
                super().__init__(host=self.access.host, port=port, label=label, verbose=False)
        finally:
            websockets_server.serve = original  # type: ignore[misc]
        if self.get_port() != port:
            self.stop()
            raise ConfigError("viser did not start its server through the checks of gausim; expected viser 1.1.1.")
        loop = self.get_event_loop()
        loop.call_soon_threadsafe(loop.set_exception_handler, self._failed)
        self.gui.configure_theme(show_share_button=False, show_logo=False)
        # The theme hides the button; its request would open a tunnel to a public server.
        for kind in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
            self._websock_server.unregister_handler(kind)
        shown = "127.0.0.1" if self.access.host in ("localhost", "0.0.0.0", "::") else self.access.host
        query = f"?token={self.access.token}" if self.access.token else ""
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/{query}"

    def _failed(self, _: object, context: dict[str, Any]) -> None:
        """Counts and logs errors that handlers of viser raise for well-formed messages."""
        self.failed += 1
        logging.getLogger(__name__).info("a message failed: %s", context.get("exception", context.get("message")))

    @property
    def displayed(self) -> float:
        """Frames per second sent on the fastest connection."""
        return max((rate.per_second for rate in list(self.sent.values())), default=0.0)
