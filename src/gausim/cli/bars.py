"""Progress bars on the standard error, which vanish when they are done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn


def bars(*columns: ProgressColumn) -> Progress:
    """A context manager that shows tasks: what they are called, a bar, and the columns; by default counts and time."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    shown = columns or (MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(
        TextColumn("{task.description}"), BarColumn(), *shown, console=Console(stderr=True), transient=True
    )  # fmt: skip


@contextmanager
def named_bar(total: int, title: str) -> Iterator[Callable[[str], None]]:
    """A bar of ``total`` items; what it gives advances it by one, whose name is shown."""
    with bars() as shown:
        task = shown.add_task(title, total=total)
        yield lambda name: shown.update(task, advance=1, description=f"{title}: {name}")


@contextmanager
def byte_bar(total: int, title: str, *, pieces: bool = False) -> Iterator[Callable[[int], None]]:
    """A bar of ``total`` bytes; what it gives takes the bytes so far, or those of each of the ``pieces``."""
    from rich.progress import DownloadColumn, TransferSpeedColumn

    with bars(DownloadColumn(), TransferSpeedColumn()) as shown:
        task = shown.add_task(title, total=total)
        if pieces:
            yield lambda count: shown.advance(task, count)
        else:
            yield lambda count: shown.update(task, completed=count)
