"""Writer of reports: from directories of runs to HTML, Markdown, LaTeX and CSV files."""

from __future__ import annotations

import csv
import io
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from gausim.io.files import write_durably
from gausim.pictures.frames import SEEN, UNSEEN
from gausim.report.layouts import SECTIONS, grids
from gausim.report.media import object_figures
from gausim.report.opening import Opening, make_openings, unanswered
from gausim.report.render import grouped, results_latex, results_page
from gausim.report.runs import RunRecord, find_runs
from gausim.report.study import Study, counted, make_study
from gausim.results.pivot import Grid, cell_texts
from gausim.results.table import Made

# In a run's directory, where `gausim export RUN --format page --out RUN/page.html` puts it.
PAGE_TO_PULL = "page.html"
CSV_HEAD = (
    "row", "kind", "object", "split", "views", "metric", "seed", "value", "deviation", "unit", "status", "runs",
    "config", "commit", "scene_sha256", "manifest_sha256",
)  # fmt: skip
PAGE, MARKDOWN, LATEX, NUMBERS = "report.html", "results.md", "tables.tex", "numbers.csv"


@dataclass(frozen=True, eq=False)
class Report:
    """A written report."""

    study: Study
    openings: list[Opening]  # the best run's first; empty without evaluations
    files: list[Path]  # the page first


class Sources:
    """Link targets in the report for the runs that numbers come from.

    Attributes:
        runs: all runs.
        sets: sets of several runs from which a number was computed.
    """

    def __init__(self, study: Study, out: Path) -> None:
        """Collects the sources; links are relative to the report's folder ``out``."""
        self._out, self._study, self.runs = out.resolve(), study, study.runs
        every = [study.sources(group.label, name) for group in study.groups for name in group.objects]
        self.sets = [same for same in dict.fromkeys(every) if len(same) > 1]
        self._anchors: dict[tuple[RunRecord, ...], str] = {(run,): f"run-{i}" for i, run in enumerate(self.runs, 1)}
        self._anchors |= {same: f"runs-{i}" for i, same in enumerate(self.sets, 1)}

    def anchor(self, runs: Sequence[RunRecord]) -> str:
        """Link target of a number computed from ``runs``; empty without runs."""
        return self._anchors.get(tuple(runs), "")

    def of(self, row: str, name: str) -> str:
        """Link target of a row's numbers of an object."""
        return self.anchor(self._study.sources(row, name))

    def missing(self, row: str, name: str, metric: str) -> str:
        """Why a row has no figure; empty where that needs no word."""
        group = next((group for group in self._study.groups if group.label == row), None)
        return group.state(name, metric) if group is not None and metric in ("lpips", "flip") else ""

    def link(self, run: RunRecord) -> str:
        """Relative path of a run's directory."""
        return quote(Path(os.path.relpath(run.path.resolve(), self._out)).as_posix())

    def page_to_pull(self, run: RunRecord) -> str:
        """Relative path of the page that simulates a run's object; empty without it."""
        return f"{self.link(run)}/{PAGE_TO_PULL}" if (run.path / PAGE_TO_PULL).is_file() else ""


def write_report(
    roots: Sequence[Path],
    out: Path,
    *,
    title: str = "Report",
    pictures: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> Report:
    """Writes the report of all runs at or below ``roots`` to ``out``, which is not searched for runs.

    ``pictures``: whether the page has figures and videos. ``say`` is called with messages on the progress.

    Raises:
        RunError: a root is no directory, or there is no run.
    """
    study = make_study(find_runs(roots, skip=out), title)
    tables = grids(study)
    if pictures:
        say("videos of the runs")
    openings, left = make_openings(study, pictures=pictures)
    exhibits, notes = [], list(study.notes)
    for name in study.objects if pictures else ():
        say(f"pictures of {name}")
        figures, problems = object_figures(study, name)
        exhibits += [(name, figures)] if figures else []
        notes += [f"{name}: {problem}" for problem in dict.fromkeys(problems)]
    shown = {"left": left, "sources": Sources(study, out), "exhibits": exhibits, "notes": notes}
    written = _write(out, {PAGE: _page(study, tables, openings, **shown), NUMBERS: csv_numbers(study)})
    return Report(study, openings, [*written, *write_tables(out, study, notes)])


def _page(study: Study, tables: Sequence[Grid], openings: Sequence[Opening], **content: object) -> str:
    """The page: one HTML file without scripts or external resources, all texts escaped.

    ``openings`` are first screens, shown one at a time; ``content`` are further names of the template.
    """
    sections = [(name, [grid for grid in tables if grid.section == name]) for name in SECTIONS]
    seen, unseen = ("#{:02x}{:02x}{:02x}".format(*color) for color in (SEEN, UNSEEN))
    environment = Environment(
        loader=PackageLoader("gausim.report"), undefined=StrictUndefined, trim_blocks=True, autoescape=True
    )
    return environment.get_template("page.html").render(
        content,
        title=study.results.title,
        openings=openings,
        summary=summary_line(study),
        remedies=unanswered(study),
        sections=[(name, own) for name, own in sections if own and openings],
        grouped=grouped,
        cell_texts=cell_texts,
        seen_color=seen,
        unseen_color=unseen,
    )


def summary_line(study: Study) -> str:
    """Number of runs, by state."""
    states = Counter(run.status for run in study.runs)
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    objects = ", ".join(study.objects) or "none"
    return f"{counted(len(study.runs), 'run')}: {shown}; {counted(len(study.groups), 'row')}; objects: {objects}."


def write_tables(out: Path, study: Study, notes: Sequence[str]) -> list[Path]:
    """Writes all tables as Markdown, with notes, and LaTeX."""
    made, tables = study.results.made or Made("unknown"), grids(study)
    page = results_page(study.results.title, made, tables, notes)
    return _write(out, {MARKDOWN: page, LATEX: results_latex(made, tables)})


def _write(out: Path, files: dict[str, str]) -> list[Path]:
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_durably(out / name, text.encode("utf-8", errors="replace"))
    return [out / name for name in files]


def csv_numbers(study: Study) -> str:
    """The long table at full precision, a line per seed, and a line for every row without figures."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, CSV_HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    sources: dict[tuple[str, str], dict[str, str]] = {}
    for entry in study.results.table:
        key = entry.row, entry.object
        if key not in sources:
            sources[key] = _sources(study.sources(*key), entry.object)
        own = {name: getattr(entry, name) for name in CSV_HEAD[:9]}
        unit = study.results.metrics[entry.metric].unit
        writer.writerow(spreadsheet_cells({**own, "unit": unit, **sources[key]}))
    for group in study.groups:
        for name in group.objects:
            if not group.entries(name):
                status = {"row": group.label, "kind": "method", "object": name, "status": group.state(name, "")}
                writer.writerow(spreadsheet_cells({**status, **_sources(group.of(name), name)}))
    return stream.getvalue()


def spreadsheet_cells(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row whose texts no spreadsheet takes for a formula: those that begin like one follow an apostrophe.

    Numbers with a sign, such as the frames ahead ``+10``, stay as they are.
    """
    return {key: f"'{value}" if isinstance(value, str) and _is_formula(value) else value for key, value in row.items()}


def _is_formula(text: str) -> bool:
    return text.startswith(("=", "+", "-", "@", "\t", "\r")) and re.fullmatch(r"[+-]\d+(\.\d+)?", text) is None


def _sources(runs: Sequence[RunRecord], name: str) -> dict[str, str]:
    hashes = [run.data_hashes.get(name, ["?", "?"]) for run in runs]
    columns = {
        "runs": [r.name for r in runs], "config": [r.config_hash for r in runs], "commit": [r.commit for r in runs],
        "scene_sha256": [h[0] for h in hashes], "manifest_sha256": [h[1] for h in hashes],
    }  # fmt: skip
    return {key: ";".join(dict.fromkeys(column)) for key, column in columns.items()}
