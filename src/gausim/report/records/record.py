"""Records of measured tables: small JSON files that outlive the run directories, from which pages are made.

    {"schema": "gausim.record/1", "title",
     "made": {"recorded", "commits": [...], "commands": [...], "hardware": [...], "test", "missing": [...]},
     "facts": {NAME: number or text},                       single figures that a page's sentences name
     "tables": [{"key", "title", "caption", "stub": [heading, ...], "columns": [{"label", "digits", "better"}],
                 "rows": [{"label": [text, ...], "cells": [CELL, ...], "reference"}], "groups"}]}

A CELL is a number, a text, null, or ``{"mean", "seeds": [mean of each seed], "seed_std", "std"}``: deviations over
seeds and, apart from it, over sequences. ``better`` is low, high, one (nearest to 1) or empty; the best of the rows
that share their first ``groups`` labels is printed bold.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal

import msgspec

from gausim.core import RunError
from gausim.io.files import write_durably

SCHEMA = "gausim.record/1"


class Figure(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """A measured figure: mean over seeds, its parts, and deviations over seeds and over sequences."""

    mean: float
    seeds: list[float] = []
    seed_std: float | None = None
    std: float | None = None


Cell = float | str | Figure | None


class Column(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """A column: heading, digits after the point (None: as stored), and which figures are better."""

    label: str
    digits: int | None = 2
    better: Literal["", "low", "high", "one"] = ""


class Row(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """A row: its labels and its cells, one per column; a reference, which sees the truth, is never the best."""

    label: list[str]
    cells: list[Cell]
    reference: bool = False


class RecordTable(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """A table; ``groups`` is the number of labels that define the rows among which the best is marked."""

    key: str
    columns: list[Column]
    rows: list[Row]
    stub: list[str] = msgspec.field(default_factory=lambda: ["method"])
    title: str = ""
    caption: str = ""
    groups: int = 0

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.columns) or len(row.label) != len(self.stub):
                raise ValueError(
                    f"table {self.key}, row {row.label}: expected {len(self.stub)} labels and {len(self.columns)} "
                    f"cells, got {len(row.label)} and {len(row.cells)}"
                )


class Made(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """Origin of the figures."""

    recorded: str  # date, or that it was before records existed
    commits: list[str] = []
    commands: list[str] = []
    hardware: list[str] = []
    test: str = ""  # trials and looks, where figures are of a test part
    missing: list[str] = []  # runs without figures, with their state


class Record(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a file."""

    schema: str
    title: str
    made: Made
    tables: list[RecordTable]
    facts: dict[str, float | str] = {}

    def table(self, key: str) -> RecordTable:
        """The table of this key; raises RunError where there is none."""
        found = next((table for table in self.tables if table.key == key), None)
        if found is None:
            raise RunError(f"{self.title}: has no table '{key}'; it has {[table.key for table in self.tables]}.")
        return found


def save_record(path: Path, record: Record) -> None:
    """Writes a record, one row or column of a table per line."""
    text = msgspec.json.format(msgspec.json.encode(record), indent=1).decode()
    # Rows and columns are the objects at depth 4; what is in them is deeper.
    text = re.sub(r"(,?)\n(?: {5,}| {4}(?=}))", lambda end: ", " if end[1] else "", text)
    write_durably(path, (text + "\n").encode())


def load_record(path: Path) -> Record:
    """Reads a record.

    Raises:
        RunError: the file is missing or malformed.
    """
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Record)
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: expected a record of `gausim report --record`, cannot be read ({error}).") from error
    if found.schema != SCHEMA:
        raise RunError(f"{path}: field 'schema' is {found.schema!r}, expected {SCHEMA!r}. Record it again.")
    return found


def value_of(cell: Cell) -> float | None:
    """The figure of a cell, if it has one."""
    number = cell.mean if isinstance(cell, Figure) else cell
    return float(number) if isinstance(number, (int, float)) and math.isfinite(number) else None
