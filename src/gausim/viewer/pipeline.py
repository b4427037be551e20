"""Concurrent stages: each processes its newest input in a separate thread and drops older inputs."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)


class Rate:
    """Events per second over the last two seconds."""

    def __init__(self, window: float = 2.0) -> None:
        self._window, self._times = window, deque[float](maxlen=4096)

    def count(self) -> None:
        """Counts one event."""
        self._times.append(time.monotonic())

    @property
    def per_second(self) -> float:
        """Mean rate over the window [1 / s]."""
        since = time.monotonic() - self._window
        return sum(moment > since for moment in self._times.copy()) / self._window


class Worker(threading.Thread):
    """Thread that calls a function on the newest item until it is stopped, also after errors.

    Attributes:
        failures: number of errors of the function, which are logged.
    """

    def __init__(self, name: str, work: Callable[[Any], None]) -> None:
        super().__init__(name=f"gausim-{name}", daemon=True)
        self._work, self._ready, self._newest = work, threading.Condition(), deque[Any](maxlen=1)
        self._stopping, self.failures = False, 0

    def put(self, item: Any) -> None:
        """Replaces the waiting item, without blocking."""
        with self._ready:
            self._newest.append(item)
            self._ready.notify()

    def run(self) -> None:
        """Processes items until :meth:`stop`."""
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._newest or self._stopping)
                if self._stopping:
                    return
                item = self._newest.pop()
            try:
                self._work(item)
            except Exception:  # one bad frame must not end the display
                self.failures += 1
                _log.exception("%s: a frame was lost", self.name)

    def stop(self) -> None:
        """Ends the thread after the current item."""
        with self._ready:
            self._stopping = True
            self._ready.notify()
