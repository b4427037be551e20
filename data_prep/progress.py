"""Progress of a stage on standard error: one bar per step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def bars() -> Iterator[Callable[[str, int, int], None]]:
    """A function that is told (step, done, of how many); each step gets a bar."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        known: dict = {}

        def tick(step: str, done: int, total: int) -> None:
            if step not in known:
                known[step] = progress.add_task(step, total=total)
            progress.update(known[step], completed=done, total=total)

        yield tick
