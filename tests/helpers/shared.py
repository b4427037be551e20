"""Folders that are made once per test session, whichever of its processes asks first."""

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path


class Shared:
    """Makes folders below one that all processes of the session know.

    Attributes:
        folder: where they go.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)

    def __call__(self, name: str, make: Callable[[Path], object]) -> Path:
        """The folder of this name, which ``make`` writes unless it was written before; not to be changed."""
        path = self.folder / name
        with (self.folder / f"{name}.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not os.fstat(lock.fileno()).st_size:
                shutil.rmtree(path, ignore_errors=True)  # the remains of a failure
                make(path)
                lock.write("made\n")
        return path
