"""Sources of a report's numbers: runs and sets of runs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from gausim.report.gather.runs import RunRecord
from gausim.report.tables.sheets import Sheet


class Sources:
    """Link targets in the report for the sources of numbers.

    Attributes:
        runs: all runs.
        sets: sets of several runs from which a number was computed.
    """

    def __init__(self, runs: Sequence[RunRecord], sheets: Sequence[Sheet], out: Path) -> None:
        """Collects the sources; links are relative to the report's folder ``out``."""
        self._out, self.runs = out.resolve(), tuple(runs)
        every = [tuple(dict.fromkeys(e.runs)) for sheet in sheets for line in sheet.lines for e in line.entries]
        self.sets = [same for same in dict.fromkeys(every) if len(same) > 1]
        self._anchors: dict[tuple[RunRecord, ...], str] = {(run,): f"run-{i}" for i, run in enumerate(runs, 1)}
        self._anchors |= {same: f"runs-{i}" for i, same in enumerate(self.sets, 1)}

    def anchor(self, runs: Sequence[RunRecord]) -> str:
        """Link target of a number computed from ``runs``; empty without runs."""
        return self._anchors.get(tuple(dict.fromkeys(runs)), "")

    def link(self, run: RunRecord) -> str:
        """Relative path of a run's directory."""
        return quote(Path(os.path.relpath(run.path.resolve(), self._out)).as_posix())
