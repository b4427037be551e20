"""Output of commands: progress bars, and final sentences on the result with one address and the next commands."""

import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

# Limit of sentences on the terminal; the page or table covers all objects.
MOST_SENTENCES = 3
PUSH = "--force on=tip weights=3 direction=x"
OWN_OBJECT = ("train", "data=DIRECTORY")


def bars(*columns: "ProgressColumn") -> "Progress":
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


def end(sentences: Sequence[str], kind: str, address: Path, *commands: Sequence[object]) -> None:
    """Prints the result in at most three lines, its address, and the next commands, as arguments of gausim.

    Of more than three sentences only the number of the others is printed. ``kind``: ``page``, ``tables``,
    ``videos``, ``run``.
    """
    lines = list(sentences[:MOST_SENTENCES])
    left = len(sentences) - len(lines)
    lines.append(f"{kind}: {address.resolve().as_uri()}" + (f" ({left} more objects)" if left else ""))
    shown = [" ".join([program(), *(shlex.quote(str(word)) for word in words)]) for words in commands]
    lines += [f"{'next:' if i == 0 else '     '} {command}" for i, command in enumerate(shown)]
    print("\n".join(lines), flush=True)


def program() -> str:
    """The command to call gausim: its name if the shell finds it, else the path of the current call."""
    called = Path(sys.argv[0])
    return shlex.quote(str(called)) if called.name == "gausim" and shutil.which("gausim") is None else "gausim"


def push(run: Path | str, name: str | None = None) -> list[object]:
    """The command that pushes an object of a run."""
    return ["simulate", run, *(["--objects", name] if name else []), *PUSH.split()]
