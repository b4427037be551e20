"""Log messages while numba or Warp compiles, so that a first call of some seconds does not seem to hang."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ANNOUNCE_AFTER = 1.0  # [s]; loading compiled functions from numba's cache takes less
logger = logging.getLogger(__name__)
_compiled: set[str] = set()


@contextmanager
def announced(name: str, *, compiler: str = "numba") -> Iterator[None]:
    """Logs that ``name`` is being compiled if its first block of the process takes more than ANNOUNCE_AFTER."""
    if name in _compiled:
        yield
        return
    text = f"Compiling {name} (once, some seconds; {compiler} keeps the result for later runs)."
    timer = threading.Timer(ANNOUNCE_AFTER, logger.warning, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
        _compiled.add(name)
    finally:
        timer.cancel()
