"""Where every number of a report comes from: its run, or its set of runs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from gausim.report.gather.runs import RunRecord
from gausim.report.tables.sheets import Sheet


class Sources:
    """Gives every set of runs that a number comes from a place in the report to link to.

    Attributes:
        runs: all runs.
        sets: the sets of several runs that some number was computed from.
    """

    def __init__(self, runs: Sequence[RunRecord], sheets: Sequence[Sheet], out: Path) -> None:
        """Collects them; ``out`` is the report's folder, which links are relative to."""
        self._out, self.runs = out.resolve(), tuple(runs)
        every = [tuple(dict.fromkeys(e.runs)) for sheet in sheets for line in sheet.lines for e in line.entries]
        self.sets = [same for same in dict.fromkeys(every) if len(same) > 1]
        self._anchors: dict[tuple[RunRecord, ...], str] = {(run,): f"run-{i}" for i, run in enumerate(runs, 1)}
        self._anchors |= {same: f"runs-{i}" for i, same in enumerate(self.sets, 1)}

    def anchor(self, runs: Sequence[RunRecord]) -> str:
        """Where a number computed from these runs links to; empty where it comes from none."""
        return self._anchors.get(tuple(dict.fromkeys(runs)), "")

    def link(self, run: RunRecord) -> str:
        """The relative address of a run's directory."""
        return quote(Path(os.path.relpath(run.path.resolve(), self._out)).as_posix())
