"""Download of one file, with resumption after interruptions and a limit of its size."""

from __future__ import annotations

import http.client
import re
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from io import BufferedIOBase
from pathlib import Path
from urllib.parse import urlsplit

import gausim
from gausim.core.errors import FetchError

ATTEMPTS, PAUSE = 5, 1.0  # number of attempts; pause before the second [s], doubled before each later one
_TIMEOUT = 30.0  # seconds without a byte
_CHUNK = 1 << 18
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")
# Errors of the connection, as opposed to the local disk.
_BROKEN = (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError)


def is_url(address: str) -> bool:
    """Whether an address is a URL of http or https; otherwise it is a path."""
    return urlsplit(address).scheme in ("http", "https")


def read_text(address: str, *, most_bytes: int) -> str:
    """Reads a short text from the web or a file.

    Raises:
        FetchError: the text is unreachable, too long, or not UTF-8.
    """
    try:
        stream, _, _ = _opened(address, 0)
        with stream:
            data = stream.read(most_bytes + 1)
    except _BROKEN as error:
        raise _unreadable(address, error) from error
    if len(data) > most_bytes:
        raise FetchError(f"{address}: expected at most {most_bytes} bytes, found more. Check the address.")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise FetchError(f"{address}: expected a text in UTF-8 ({error}). Check the address.") from error


def continue_download(address: str, part: Path, *, size: int, advance: Callable[[int], None]) -> None:
    """Downloads ``size`` bytes from a URL or path to ``part``, from its present bytes on where the server can.

    After an interruption the file is kept for the next call. ``advance`` is called with the number of bytes so far.

    Raises:
        FetchError: the address is unreachable or has a file of another size.
    """
    tries = 0
    while (have := _length(part)) != size:
        if have > size:
            part.unlink()
            continue
        try:
            _append(address, part, have, size, advance)
        except _BROKEN as error:
            tries, final = tries + 1, not is_url(address)
            if isinstance(error, urllib.error.HTTPError):
                error.close()
                final = error.code < 500 and error.code not in (408, 416, 429)
                if error.code == 416:  # range not satisfiable: restart the download
                    part.unlink(missing_ok=True)
            if final or tries == ATTEMPTS:
                raise _unreadable(address, error, kept=_length(part)) from error
            time.sleep(PAUSE * 2 ** (tries - 1))
    advance(size)


def _append(address: str, part: Path, have: int, size: int, advance: Callable[[int], None]) -> None:
    """Appends the bytes of one connection; raises a ``ConnectionError`` where it ends too early."""
    other = "It is another file: tell whoever keeps the registry."
    stream, start, total = _opened(address, have)
    with stream:
        if total not in (None, size):
            raise FetchError(f"{address}: expected {size} bytes, as the registry says, found {total}. {other}")
        with part.open("r+b" if start else "wb") as file:
            file.seek(start)
            while chunk := stream.read(min(_CHUNK, size + 1 - file.tell())):
                file.write(chunk)
                advance(file.tell())
            done = file.tell()
    if done > size:
        part.unlink()
        raise FetchError(f"{address}: expected {size} bytes, as the registry says, found more. {other}")
    if done < size:
        raise ConnectionError(f"the connection ended after {done} of {size} bytes")


def _opened(address: str, offset: int) -> tuple[BufferedIOBase, int, int | None]:
    """The stream, its offset in the file (0 if the server ignores ranges), and the file's size if known."""
    if is_url(address):
        return _web(address, offset)
    try:
        stream = Path(address).open("rb")
        stream.seek(offset)
        return stream, offset, Path(address).stat().st_size
    except OSError as error:  # an error of the source, not of the target disk
        raise urllib.error.URLError(error) from error


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


def _unreadable(address: str, error: Exception, *, kept: int = 0) -> FetchError:
    status = error.code if isinstance(error, urllib.error.HTTPError) else None
    said = str(getattr(error, "reason", error)) or type(error).__name__
    if not is_url(address):
        remedy = "Check that the file is there."
    elif status is not None and status < 500:
        remedy = "Check the address, or tell whoever keeps the registry."
    else:
        remedy = (
            "Check the connection (and HTTPS_PROXY, where there is a proxy) and give the same command again, or give a "
            "copy with --mirror DIR."
        )
    stays = f" The {kept} bytes that came are kept." if kept else ""
    return FetchError(f"{address}: cannot be read ({f'HTTP {status}, ' if status else ''}{said}).{stays} {remedy}")
