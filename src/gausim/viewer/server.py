"""A viser server with access control."""

import contextlib
import io
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from viser import _messages as viser_messages

from gausim.core.errors import ConfigError
from gausim.viewer.access import Access, answer


class GuardedServer(viser.ViserServer):
    """A viser server that answers only the requests that ``access`` (with its token) allows, at the address ``url``.

    viser has no setting for that; its websockets server takes the check in the place of viser's own handler.
    """

    def __init__(self, access: Access, *, label: str = "gausim") -> None:
        """Starts to listen.

        Raises:
            ConfigError: the address cannot be bound, or viser has no hook for the check.
        """
        self.access = access = access.checked()
        try:
            family = socket.AF_INET6 if ":" in access.host else socket.AF_INET
            listener = socket.create_server((access.host, access.port), family=family)
        except (OSError, OverflowError) as error:
            raise ConfigError(f"--host {access.host} --port {access.port}: {error}. Choose others.") from error
        port, original = listener.getsockname()[1], websockets_server.serve

        def serve(handler: Any, *_: object, process_request: Callable[..., Any], **options: Any) -> Any:
            check = partial(answer, access, f"gausim_{port}", process_request)
            return original(handler, **options | {"sock": listener, "process_request": check, "max_size": 2 << 20})

        websockets_server.serve = serve  # type: ignore[assignment, misc]
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                super().__init__(host=access.host, port=port, label=label, verbose=False)
        finally:
            websockets_server.serve = original  # type: ignore[misc]
        if self.get_port() != port:
            raise ConfigError("viser did not start through the access check of gausim. `pip install viser==1.1.1`.")
        self.gui.configure_theme(show_share_button=False, show_logo=False)
        # The theme hides the button; its request would open a tunnel to a public server.
        for kind in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
            self._websock_server.unregister_handler(kind)
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(access.host, access.host)
        self.url = f"http://{host}:{port}/" + (f"?token={access.token}" if access.token else "")
