"""A web server of one folder on this machine, with and without Range, that can cut connections short."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


@dataclass
class LocalServer:
    """What it serves and how; ``asked`` has path and Range of every request."""

    root: Path
    ranges: bool = True
    cut_after: list[int] = field(default_factory=list)  # bytes after which each of the next connections ends
    statuses: list[int] = field(default_factory=list)  # answers of the next requests instead of the file
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    url: str = ""

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        wanted = request.headers.get("Range")
        self.asked.append((request.path, wanted))
        path = self.root / request.path.lstrip("/")
        if self.statuses or not path.is_file():
            request.send_error(self.statuses.pop(0) if self.statuses else 404)
            return
        data, start = path.read_bytes(), 0
        if wanted and self.ranges:
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])
            if start >= len(data):
                request.send_error(416)
                return
            request.send_response(206)
            request.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
        else:
            request.send_response(200)
        request.send_header("Content-Length", str(len(data) - start))
        request.end_headers()
        stop = start + self.cut_after.pop(0) if self.cut_after else len(data)
        request.wfile.write(data[start:stop])


@contextmanager
def serving(root: Path, **options) -> Iterator[LocalServer]:
    server = LocalServer(root, **options)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            server.answer(self)

        def log_message(self, *args) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.url = f"http://127.0.0.1:{http.server_port}"
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        http.shutdown()
        thread.join()
        http.server_close()
