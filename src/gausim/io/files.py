"""Files that survive a crash, and their hashes: what every writer and every manifest of this package uses."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_LEFTOVER = re.compile(r"\..+\.\d+\.tmp(\.\w+)?")


@contextmanager
def replacing(path: Path, *, previous: Path | None = None, typed: bool = False) -> Iterator[Path]:
    """A temporary file that takes the name ``path`` when the block ends without an error.

    A crash at any moment leaves the old content or the new one, never a mixture: the temporary file lies in the same
    directory, which is made, and reaches the disk before it takes the name; the directory's entry is flushed too.

    Args:
        path: the file.
        previous: where a file that ``path`` names already is kept; None replaces it.
        typed: the temporary name has the same ending, for writers that go by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix if typed else ''}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if previous is not None and path.is_file():
            _keep(path, previous)
        os.replace(temporary, path)
        _sync_directory(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_durably(
    path: Path, data: bytes, *, check: Callable[[Path], None] | None = None, previous: Path | None = None
) -> None:
    """Writes a file so that it is there whole or as it was, see :func:`replacing`.

    ``check`` is called with the temporary file and raises if what was written is not good.
    """
    with replacing(path, previous=previous) as temporary:
        temporary.write_bytes(data)
        if check is not None:
            check(temporary)


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as readable JSON, whole or not at all.

    Raises:
        ValueError: a number is NaN or infinite, which JSON cannot say.
    """
    write_durably(path, json.dumps(data, indent=1, allow_nan=False).encode() + b"\n")


def sha256(path: Path) -> str:
    """SHA-256 of a file's content in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_leftovers(folder: Path, *, deep: bool = False) -> None:
    """Removes the temporary files of processes that were killed while writing, those in folders below (``deep``) too.

    Call it as the only writer.
    """
    for path in folder.rglob(".*.tmp*") if deep else folder.glob(".*.tmp*"):
        if _LEFTOVER.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _keep(path: Path, previous: Path) -> None:
    """Names a file ``previous`` as well, so that ``path`` is there at every moment."""
    link = previous.with_name(f".{previous.name}.{os.getpid()}.tmp")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:
        os.replace(path, previous)  # a file system without hard links: for a moment there is `previous` only
        return
    try:
        os.replace(link, previous)
    finally:
        link.unlink(missing_ok=True)  # still there if both are one file already


def _sync_directory(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
