"""Says so when numba or Warp compiles: a first call that takes seconds must not look like one that hangs."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ANNOUNCE_AFTER = 1.0  # [s]; loading compiled functions from numba's cache takes less
logger = logging.getLogger(__name__)
_compiled: set[str] = set()


@contextmanager
def announced(what: str, *, keeper: str = "numba") -> Iterator[None]:
    """Logs once per process that ``what`` is being compiled, if the first block about it takes long."""
    if what in _compiled:
        yield
        return
    text = f"Compiling {what} (once, some seconds; {keeper} keeps the result for later runs)."
    timer = threading.Timer(ANNOUNCE_AFTER, logger.warning, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
        _compiled.add(what)
    finally:
        timer.cancel()
