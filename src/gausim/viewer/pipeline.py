"""Stages that overlap: each works in its own thread on the newest input, and what comes too fast is dropped."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Latest(Generic[T]):
    """A queue of length one in which the newest item takes the place of the last.

    Attributes:
        dropped: items that nobody took.
    """

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._item: T | None = None
        self.dropped = 0

    def put(self, item: T) -> None:
        """Offers an item, never waits."""
        with self._ready:
            self.dropped += self._item is not None
            self._item = item
            self._ready.notify()

    def take(self, timeout: float) -> T | None:
        """The newest item, or None when none comes within so many seconds."""
        with self._ready:
            if self._item is None:
                self._ready.wait(timeout)
            item, self._item = self._item, None
            return item


class Rate:
    """Events per second over the last two seconds."""

    def __init__(self, window: float = 2.0) -> None:
        self._window, self._times = window, deque[float](maxlen=4096)
        self._lock = threading.Lock()

    def count(self, events: int = 1) -> None:
        """Something happened, so many times."""
        now = time.monotonic()
        with self._lock:
            self._times.extend([now] * min(events, 4096))

    @property
    def per_second(self) -> float:
        """How often it happens."""
        now = time.monotonic()
        with self._lock:
            while self._times and now - self._times[0] > self._window:
                self._times.popleft()
            return len(self._times) / self._window


class Worker(threading.Thread):
    """Calls a function on the newest item of a slot until it is stopped; an error does not end it.

    Attributes:
        seconds: time spent in the function.
        count: how often it was called.
        failures: errors it raised; they are logged.
    """

    def __init__(self, name: str, source: Latest[T], work: Callable[[T], None]) -> None:
        super().__init__(name=f"gausim-{name}", daemon=True)
        self._source, self._work = source, work
        self._stopping = threading.Event()
        self.seconds, self.count, self.failures = 0.0, 0, 0

    def run(self) -> None:
        """Works until :meth:`stop`."""
        while not self._stopping.is_set():
            item = self._source.take(0.2)
            if item is None:
                continue
            start = time.perf_counter()
            try:
                self._work(item)
            except Exception:  # one bad frame must not end the display
                self.failures += 1
                if not self._stopping.is_set():
                    _log.exception("%s: a frame was lost", self.name)
            self.seconds += time.perf_counter() - start
            self.count += 1

    def stop(self) -> None:
        """Ends after the item at hand."""
        self._stopping.set()
