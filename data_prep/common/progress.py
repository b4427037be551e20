"""Many jobs on several processes, and their progress on standard error: one bar per step, none where nobody watches."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any

from gausim.cli.output import bars as plain_bars
from gausim.runs.processes import end_with

# Columns of a bar: step, number done, total.
Tick = Callable[[str, int, int], None]


@contextmanager
def bars(waiting: str | None = None) -> Iterator[Tick]:
    """A function that is told (step, done, of how many); each step has a bar until it is done. Threads may call it."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    progress = plain_bars(MofNCompleteColumn(), TimeRemainingColumn())
    progress.disable = not progress.console.is_terminal
    known: dict[str, Any] = {}
    lock = threading.Lock()
    first = None if waiting is None else progress.add_task(waiting, total=None)
    if waiting is not None:
        progress.start()

    def tick(step: str, done: int, total: int) -> None:
        with lock:
            progress.start()  # not earlier: a stage without steps may draw bars itself
            if first is not None:
                progress.update(first, visible=False)
            if step not in known:
                known[step] = progress.add_task(step, total=total)
        progress.update(known[step], completed=done, total=total, visible=done < total)

    try:
        yield tick
    finally:
        progress.stop()


def silent(step: str, done: int, total: int) -> None:
    """Tells nobody."""


def each(work: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], *, workers: int, step: str, tick: Tick) -> None:
    """Calls ``work(*job)`` for all jobs, in this process with one worker; tells ``tick`` of every one that is done.

    The first error ends it, once the jobs that have begun are done. ``work`` must be a function of a module.
    """
    if workers == 1:
        for number, job in enumerate(jobs, 1):
            work(*job)
            tick(step, number, len(jobs))
        return
    # Not forked: a fork of a process with live threads (torch, rich) can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(1, len(jobs))), mp_context=context, initializer=_begin_worker,
                             initargs=(os.getpid(),)) as pool:  # fmt: skip
        pending = [pool.submit(work, *job) for job in jobs]
        for number, done in enumerate(as_completed(pending), 1):
            if done.exception() is not None:
                pool.shutdown(cancel_futures=True)
            done.result()
            tick(step, number, len(jobs))


def _begin_worker(parent: int) -> None:
    import torch

    end_with(parent)
    torch.set_num_threads(1)
