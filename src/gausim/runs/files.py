"""Locks of run directories, and messages for errors of the disk."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gausim.core import BusyError, RunError

try:
    import fcntl
except ImportError:  # not on Windows; there directories are not locked
    fcntl = None  # type: ignore[assignment]

# Errors on writing to a disk: full, over quota, over a limit, write-protected, no permission.
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


@contextmanager
def sole_writer(lock: Path) -> Iterator[None]:
    """Locks a directory by a file in it until the block or the process ends.

    Raises:
        BusyError: another process has locked the directory.
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
    """A readable error of the disk (full, write-protected) or of any file in ``folder``; None for other errors."""
    if error.errno not in DISK_ERRORS and (folder is None or str(folder) not in str(error)):
        return None
    return RunError(
        f"{error.filename or folder or 'the disk'}: cannot be written or read ({error}). The last checkpoint, if any, "
        "is unharmed. Make room or correct the permissions; then the same command continues."
    )
