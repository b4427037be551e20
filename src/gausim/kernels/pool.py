"""A small persistent pool of Python threads for compiled kernels, which release the GIL."""

import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class WorkerPool:
    """Runs tasks on ``threads`` threads, the caller's included. Works after fork and pickling, with new threads."""

    def __init__(self, threads: int) -> None:
        """Threads start with the first parallel call."""
        self.threads = threads
        self._executor: ThreadPoolExecutor | None = None
        self._pid = 0

    def run(self, task: Callable[[Any], None], items: Sequence[Any]) -> None:
        """Calls ``task`` once for every item and returns when all are done; the first exception is raised here."""
        helpers = min(self.threads, len(items)) - 1
        if helpers < 1:
            for item in items:
                task(item)
            return
        ticket = itertools.count()  # next() on it is atomic

        def drain() -> None:
            while (i := next(ticket)) < len(items):
                task(items[i])

        executor = self._workers()
        running = [executor.submit(drain) for _ in range(helpers)]
        try:
            drain()
        finally:
            errors = [future.exception() for future in running]
        for error in errors:
            if error is not None:
                raise error

    def _workers(self) -> ThreadPoolExecutor:
        if self._executor is None or self._pid != os.getpid():
            self._executor = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="gausim")
            self._pid = os.getpid()
        return self._executor

    def __getstate__(self) -> dict[str, Any]:
        """Only the number of threads is pickled."""
        return {"threads": self.threads}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Starts without threads, like a new pool."""
        self.__init__(state["threads"])  # type: ignore[misc]


@functools.cache
def shared_pool(threads: int) -> WorkerPool:
    """The process's pool of that many threads, for all callers."""
    return WorkerPool(threads)
