"""Final output of commands: sentences on the result, one address and the next commands, without lists of files."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# Limit of sentences on the terminal; the page or table covers all objects.
MOST_SENTENCES = 3
PUSH = "--force on=tip weights=3 direction=x"
OWN_OBJECT = ("train", "data=object", "data.root=ROOT", "name=mine")


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
    return ["simulate", run, *(["--object", name] if name else []), *PUSH.split()]


def error_sentences(entries: Mapping[str, dict[str, Any]]) -> list[str]:
    """One sentence per object of ``metrics.json`` on the error of its first method in unseen frames."""
    from gausim.report.tables.verdict import outcome, sentences

    return [f"{name}: {sentences(outcome([entry], str(entry['methods'][0])))[0]}" for name, entry in entries.items()]
