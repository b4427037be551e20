"""Options of numba for all compiled functions."""

import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

logger = logging.getLogger(__name__)


def _probe() -> None:
    """Stands for all functions of gausim in the question where numba may keep compiled code."""


def caching(choose: Callable[[], object] = lambda: numba.njit(cache=True)(_probe)) -> bool:
    """Whether numba can keep compiled functions; chooses the temporary folder where the usual places are read-only.

    Args:
        choose: asks numba for a place, which raises a RuntimeError if there is none.
    """
    try:
        choose()
    except RuntimeError:
        folder = _private_folder()
        if folder is None:
            logger.warning(
                "Compiled functions cannot be kept: installation, home and temporary folder are read-only. Every "
                "command compiles them again; set NUMBA_CACHE_DIR to a folder that can be written."
            )
            return False
        os.environ["NUMBA_CACHE_DIR"] = str(folder)  # for processes that this one starts, too
        numba.config.reload_config()
    return True


def _private_folder() -> Path | None:
    """A folder of this user alone in the temporary folder; None if there can be none. Numba unpickles what is there."""
    try:
        folder = Path(tempfile.gettempdir()) / f"gausim-numba-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        return None
    others = hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o077)
    return None if others or folder.is_symlink() else folder


# Functions called from Python. Kept in numba's cache; without the unused C entry.
KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "cache": caching(), "no_cfunc_wrapper": True}
# Functions called only by compiled functions, inlined into each of them. Otherwise the process that compiles would call
# the helper's code, and a later process, which loads the caller from the cache, the copy linked into it: under fastmath
# both round differently, and runs would not repeat bit for bit. Without entry points compiling takes half the time.
HELPER: dict[str, Any] = {
    "error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True, "no_cpython_wrapper": True,
}  # fmt: skip
# fastmath without nnan and ninf: a number that overflows must not become an undefined index later.
FINITE_MATH_OFF = {"contract", "reassoc", "arcp", "nsz", "afn"}
