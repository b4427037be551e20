"""Progress bars on the standard error, removed on completion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn


def bars(*columns: ProgressColumn) -> Progress:
    """A context manager that shows tasks with name, bar and the given columns; by default counts and time."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    shown = columns or (MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(
        TextColumn("{task.description}"), BarColumn(), *shown, console=Console(stderr=True), transient=True
    )  # fmt: skip


@contextmanager
def named_bar(total: int, title: str) -> Iterator[Callable[[str], None]]:
    """A bar of ``total`` items; yields a function that advances it by one item and shows its name."""
    with bars() as shown:
        task = shown.add_task(title, total=total)
        yield lambda name: shown.update(task, advance=1, description=f"{title}: {name}")


@contextmanager
def byte_bar(total: int, title: str, *, pieces: bool = False) -> Iterator[Callable[[int], None]]:
    """A bar of ``total`` bytes; yields a function of the bytes so far, or of each piece with ``pieces``."""
    from rich.progress import DownloadColumn, TransferSpeedColumn

    with bars(DownloadColumn(), TransferSpeedColumn()) as shown:
        task = shown.add_task(title, total=total)
        if pieces:
            yield lambda count: shown.advance(task, count)
        else:
            yield lambda count: shown.update(task, completed=count)
