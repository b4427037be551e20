"""Run directories on a disk: one writer each, errors of the disk told in words."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gausim.core import BusyError, RunError

try:
    import fcntl
except ImportError:  # not on Windows; there nothing keeps a second process out
    fcntl = None  # type: ignore[assignment]

# What a disk answers that will not take more: full, over quota, over a limit, write-protected, not for this user.
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


@contextmanager
def sole_writer(lock: Path, *, doing: str = "training here") -> Iterator[None]:
    """Keeps other processes out of a directory until the block, or this process, ends, however it ends.

    Args:
        lock: a file in it.
        doing: what the others are told that this process does.

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
                f"{lock.parent}: another process ({file.read().strip() or 'unknown'}) is {doing}. Wait for it or "
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
