"""Many jobs on several processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

from data_prep.common.progress import Tick


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
    with ProcessPoolExecutor(min(workers, max(1, len(jobs))), mp_context=context, initializer=_one_thread) as pool:
        pending = [pool.submit(work, *job) for job in jobs]
        for number, done in enumerate(as_completed(pending), 1):
            if done.exception() is not None:
                pool.shutdown(cancel_futures=True)
            done.result()
            tick(step, number, len(jobs))


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)
