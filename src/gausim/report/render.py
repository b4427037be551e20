"""The page of a report: one HTML file without scripts or external resources."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import Study
from gausim.report.opening import Opening, unanswered
from gausim.report.pictures.frames import FORESEEN, SEEN
from gausim.report.pictures.media import Exhibit
from gausim.report.tables.sheets import SECTIONS, Sheet


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


@dataclass(frozen=True, eq=False)
class Content:
    """Contents of a report."""

    title: str
    study: Study
    sheets: Sequence[Sheet]
    sources: Sources  # link targets of their numbers
    openings: Sequence[Opening]  # first screens, shown one at a time
    left: int = 0  # number of omitted first screens
    exhibits: Sequence[tuple[str, list[Exhibit]]] = ()  # pictures and videos by object
    notes: Sequence[str] = ()  # notes for the reader


def html_page(content: Content) -> str:
    """The page, with all texts escaped and a security policy that forbids the browser to load anything."""
    sections = [(name, [sheet for sheet in content.sheets if sheet.section == name]) for name in SECTIONS]
    environment = Environment(
        loader=PackageLoader("gausim.report"), undefined=StrictUndefined, trim_blocks=True, autoescape=True
    )
    return environment.get_template("page.html").render(
        vars(content),
        summary=summary_line(content.study),
        remedies=unanswered(content.study),
        sections=[(name, own) for name, own in sections if own and content.openings],
        exhibits=[(name, figures) for name, figures in content.exhibits if figures],
        seen_color=_rgb(SEEN),
        foreseen_color=_rgb(FORESEEN),
    )


def summary_line(study: Study) -> str:
    """Number of runs, by state."""
    states = Counter(run.status for run in study.runs)
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    objects = ", ".join(study.objects) or "none"
    return f"{_counted(len(study.runs), 'run')}: {shown}; {_counted(len(study.groups), 'row')}; objects: {objects}."


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _rgb(color: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)
