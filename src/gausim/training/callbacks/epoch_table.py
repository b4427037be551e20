"""A CSV file with one row per epoch, which a resumed run goes on with."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gausim.io.files import write_durably


class EpochTable:
    """Appends rows; rows of epochs that a resumed run does again are dropped first."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        """``columns`` holds ``epoch``; values of other names in a row are left out."""
        self._path, self._columns = path, tuple(columns)

    def resume_at(self, epoch: int) -> None:
        """Keeps the rows of the first ``epoch`` epochs; the last row may be torn, but is not of these."""
        if not self._path.is_file():
            return
        with self._path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if _number(row.get("epoch")) <= epoch]
        write_durably(self._path, self._text(rows, header=True).encode())

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds a row; columns it does not know stay empty."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        shown = {name: short(row[name]) if name in row else "" for name in self._columns}
        text = self._text([shown], header=not self._path.is_file())
        with self._path.open("a", newline="") as file:
            file.write(text)

    def _text(self, rows: Sequence[Mapping[str, Any]], *, header: bool) -> str:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, extrasaction="ignore")
        if header:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()


def short(value: Any) -> Any:
    """Floats with five digits."""
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _number(text: str | None) -> float:
    try:
        return float(text or "inf")
    except ValueError:
        return float("inf")
