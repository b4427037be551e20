"""Files that survive a crash: written durably, one writer per directory, errors of the disk told in words."""

from __future__ import annotations

import errno
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gausim.core import BusyError, RunError

try:
    import fcntl
except ImportError:  # not on Windows; there nothing keeps a second process out
    fcntl = None  # type: ignore[assignment]

# What a disk answers that will not take more: full, over quota, over a limit, write-protected, not for this user.
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)
_LEFTOVER = re.compile(r"\..+\.\d+\.tmp")


def write_durably(
    path: Path, data: bytes, *, check: Callable[[Path], None] | None = None, previous: Path | None = None
) -> None:
    """Writes a file so that a crash at any moment leaves the old content or the new one, never a mixture.

    The bytes go to a temporary file in the same directory, reach the disk, are checked there, and only then take the
    name; the directory's entry is flushed too.

    Args:
        path: the file.
        data: its content.
        check: raises if what was written is not good; called with the temporary file.
        previous: where a file that ``path`` names already is kept; None replaces it.

    Raises:
        OSError: the disk refuses; the old file stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if check is not None:
            check(temporary)
        if previous is not None and path.is_file():
            _keep(path, previous)
        os.replace(temporary, path)
        _sync_directory(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


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


def remove_leftovers(folder: Path) -> None:
    """Removes the temporary files of processes that were killed while writing. Call it as the only writer."""
    for path in folder.glob(".*.tmp"):
        if _LEFTOVER.fullmatch(path.name):
            path.unlink(missing_ok=True)


@contextmanager
def sole_writer(lock: Path) -> Iterator[None]:
    """Keeps other processes out of a directory until the block, or this process, ends, however it ends.

    Raises:
        BusyError: another process is in it.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("a+") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise BusyError(
                f"{lock.parent}: another process ({file.read().strip() or 'unknown'}) is training here. Wait for it or "
                "end it; then the same command continues."
            ) from error
        except OSError as error:
            warnings.warn(f"{lock}: this file system has no locks ({error}); start each run only once.", stacklevel=3)
        file.truncate(0)
        file.write(f"process {os.getpid()}\n")
        file.flush()
        yield


def unwritable(error: OSError, folder: Path | None = None) -> RunError | None:
    """An error of the disk for people: full, write-protected, or anything about ``folder``; None if it is another."""
    if error.errno not in DISK_ERRORS and (folder is None or str(folder) not in str(error)):
        return None
    return RunError(
        f"{error.filename or folder or 'the disk'}: cannot be written or read ({error}). The last checkpoint, if any, "
        "is unharmed. Make room or correct the permissions; then the same command continues."
    )
