"""Progress of a stage on standard error: one bar per step, none where nobody watches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

# Columns of a bar: step, number done, total.
Tick = Callable[[str, int, int], None]


@contextmanager
def bars(waiting: str | None = None) -> Iterator[Tick]:
    """A function that is told (step, done, of how many); each step has a bar until it is done. Threads may call it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
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
