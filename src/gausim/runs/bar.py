"""A progress bar around the items of a loop."""

from collections.abc import Iterable
from typing import TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def with_bar(items: Iterable[T], step: str, *, total: int | None = None, quiet: bool = False) -> Iterable[T]:
    """The items, with a progress bar if standard error is a terminal and ``quiet`` is not set."""
    console = Console(stderr=True)
    hidden = quiet or not console.is_terminal
    return track(items, step, total=total, console=console, transient=True, disable=hidden)
