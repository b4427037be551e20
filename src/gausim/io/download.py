"""One file from an address: continued where it broke off, never longer than it should be."""

from __future__ import annotations

import http.client
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from urllib.parse import urlsplit

import gausim
from gausim.core.errors import FetchError

ATTEMPTS, PAUSE = 5, 1.0  # connections; seconds before the second, doubled before each later one
_TIMEOUT = 30.0  # seconds without a byte
_CHUNK = 1 << 18
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")
_BROKEN = (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError)


def is_url(address: str) -> bool:
    """Whether an address is of the web; anything else is a path."""
    return urlsplit(address).scheme in ("http", "https")


def read_text(address: str, *, most_bytes: int) -> str:
    """A short text from the web or a file.

    Raises:
        FetchError: it cannot be had, is longer, or is not UTF-8.
    """
    try:
        with _opened(address, 0) as (stream, _, _):
            data = b""
            while chunk := _read(stream, most_bytes + 1 - len(data)):
                data += chunk
    except _Broken as broken:
        raise FetchError(_unreadable(address, broken.reason)) from broken
    if len(data) > most_bytes:
        raise FetchError(f"{address}: expected at most {most_bytes} bytes, found more. Check the address.")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise FetchError(f"{address}: expected a text in UTF-8 ({error}). Check the address.") from error


def continue_download(address: str, part: Path, *, size: int, advance: Callable[[int], None]) -> None:
    """Brings a file to its size, from the bytes on that are there already if the server can (HTTP Range).

    Args:
        address: a URL of http or https, or a path.
        part: the file; it stays for the next call where this one is cut short.
        size: bytes that it is to have.
        advance: told how many bytes there are now.

    Raises:
        FetchError: the address cannot be reached or has a file of another size.
        OSError: the disk refuses.
    """
    tries = 0
    while (have := _length(part)) != size:
        if have > size:
            part.unlink()
            continue
        broken = _append(address, part, have, size, advance)
        if broken is None:
            continue
        tries += 1
        final = isinstance(broken, urllib.error.HTTPError) and broken.code < 500 and broken.code not in (408, 416, 429)
        if final or not is_url(address) or tries == ATTEMPTS:
            raise FetchError(_unreadable(address, broken, kept=_length(part))) from broken
        time.sleep(PAUSE * 2 ** (tries - 1))
    advance(size)


def _append(address: str, part: Path, have: int, size: int, advance: Callable[[int], None]) -> Exception | None:
    """Adds what one connection brings; returns what broke it off."""
    try:
        with _opened(address, have) as (stream, start, total):
            if total not in (None, size):
                raise FetchError(f"{address}: expected {size} bytes, as the registry says, found {total}. {_OTHER}")
            with part.open("r+b" if start else "wb") as file:
                file.seek(start)
                while chunk := _read(stream, size + 1 - file.tell()):
                    file.write(chunk)
                    advance(file.tell())
                if file.tell() > size:
                    part.unlink()
                    raise FetchError(f"{address}: expected {size} bytes, as the registry says, found more. {_OTHER}")
                done = file.tell()
    except _Broken as broken:
        if isinstance(broken.reason, urllib.error.HTTPError):
            broken.reason.close()
            if broken.reason.code == 416:  # it has no bytes from there on: begin anew
                part.unlink(missing_ok=True)
        return broken.reason
    return None if done == size else ConnectionError(f"the connection ended after {done} of {size} bytes")


_OTHER = "It is another file: tell whoever keeps the registry."


class _Broken(Exception):
    """What went wrong on the way, as against on our disk."""

    def __init__(self, reason: Exception) -> None:
        super().__init__(str(reason))
        self.reason = reason


def _read(stream: BufferedIOBase, room: int) -> bytes:
    try:
        return stream.read(min(_CHUNK, room)) if room > 0 else b""
    except (*_BROKEN, OSError) as error:
        raise _Broken(error) from error


@contextmanager
def _opened(address: str, offset: int) -> Iterator[tuple[BufferedIOBase, int, int | None]]:
    """A stream from ``offset`` on, or from where the server begins; where that is; the file's size if it is said."""
    try:
        stream, start, total = _web(address, offset) if is_url(address) else _file(address, offset)
    except (*_BROKEN, OSError) as error:
        raise _Broken(error) from error
    with stream:
        yield stream, start, total


def _file(address: str, offset: int) -> tuple[BufferedIOBase, int, int]:
    path = Path(address)
    stream = path.open("rb")
    stream.seek(offset)
    return stream, offset, path.stat().st_size


def _web(address: str, offset: int) -> tuple[BufferedIOBase, int, int | None]:
    headers = {"User-Agent": f"gausim/{gausim.__version__}", "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    answer = urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=_TIMEOUT)
    if answer.status == 206:
        found = _RANGE.fullmatch(answer.headers.get("Content-Range", ""))
        if found is None or int(found[1]) != offset:
            answer.close()
            raise http.client.HTTPException(f"asked for the bytes from {offset}, got {found and found[0]}")
        return answer, offset, None if found[2] == "*" else int(found[2])
    length = answer.headers.get("Content-Length", "")
    return answer, 0, int(length) if length.isdecimal() else None


def _length(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _unreadable(address: str, error: Exception, *, kept: int = 0) -> str:
    stays = f" The {kept} bytes that came are kept." if kept else ""
    return f"{address}: cannot be read ({_told(error)}).{stays} {_remedy(address, error)}"


def _told(error: BaseException) -> str:
    """An error of the network in few words."""
    if isinstance(error, urllib.error.HTTPError):
        return f"HTTP {error.code}, {error.reason}"
    if isinstance(error, urllib.error.URLError):
        return str(error.reason)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__


def _remedy(address: str, error: BaseException) -> str:
    """What to do about it."""
    if not is_url(address):
        return "Check that the file is there."
    if isinstance(error, urllib.error.HTTPError) and error.code < 500:
        return "Check the address, or tell whoever keeps the registry."
    return (
        "Check the connection (and HTTPS_PROXY, where there is a proxy) and give the same command again, or give a "
        "copy with --mirror DIR."
    )
