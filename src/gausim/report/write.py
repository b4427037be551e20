"""Writer of reports: from directories of runs to HTML, Markdown, LaTeX and CSV files."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from gausim.io.files import write_durably
from gausim.pictures.frames import FORESEEN, SEEN
from gausim.report.gather.runs import RunRecord, find_runs
from gausim.report.gather.study import Group, Study, cell, counted, make_study, reference_rows
from gausim.report.media import object_figures
from gausim.report.opening import Opening, make_openings, unanswered
from gausim.report.records.measure import measured_record
from gausim.report.records.print import results_latex, results_page
from gausim.report.records.record import Record
from gausim.report.tables.overview import make_sheets
from gausim.report.tables.sheets import SECTIONS, Sheet

CSV_HEAD = (
    "row", "kind", "object", "split", "first_frame", "end_frame", "views", "metric", "mean", "std_sequences",
    "std_seeds", "seeds", "scale", "unit", "status", "runs", "config", "commit", "scene_sha256", "manifest_sha256",
)  # fmt: skip
PAGE, MARKDOWN, LATEX, NUMBERS = "report.html", "results.md", "tables.tex", "numbers.csv"


@dataclass(frozen=True, eq=False)
class Report:
    """A written report."""

    study: Study
    openings: list[Opening]  # the best run's first; empty without evaluations
    files: list[Path]  # the page first


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
    runs = find_runs(roots, skip=out)
    study = make_study(runs)
    sheets = make_sheets(study)
    if pictures:
        say("videos of the runs")
    openings, left = make_openings(study, pictures=pictures)
    exhibits, notes = [], list(study.notes)
    for name in study.objects if pictures else ():
        say(f"pictures of {name}")
        figures, problems = object_figures(study, name)
        exhibits += [(name, figures)] if figures else []
        notes += [f"{name}: {problem}" for problem in dict.fromkeys(problems)]
    shown = {"title": title, "left": left, "sources": Sources(runs, sheets, out), "exhibits": exhibits, "notes": notes}
    written = _write(out, {PAGE: _page(study, sheets, openings, **shown), NUMBERS: csv_numbers(study)})
    return Report(study, openings, [*written, *write_tables(out, measured_record(study, title), notes)])


def _page(study: Study, sheets: Sequence[Sheet], openings: Sequence[Opening], **content: object) -> str:
    """The page: one HTML file without scripts or external resources, all texts escaped.

    ``openings`` are first screens, shown one at a time; ``content`` are further names of the template.
    """
    sections = [(name, [sheet for sheet in sheets if sheet.section == name]) for name in SECTIONS]
    seen, foreseen = ("#{:02x}{:02x}{:02x}".format(*color) for color in (SEEN, FORESEEN))
    environment = Environment(
        loader=PackageLoader("gausim.report"), undefined=StrictUndefined, trim_blocks=True, autoescape=True
    )
    return environment.get_template("page.html").render(
        content,
        openings=openings,
        summary=summary_line(study),
        remedies=unanswered(study),
        sections=[(name, own) for name, own in sections if own and openings],
        seen_color=seen,
        foreseen_color=foreseen,
    )


def summary_line(study: Study) -> str:
    """Number of runs, by state."""
    states = Counter(run.status for run in study.runs)
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    objects = ", ".join(study.objects) or "none"
    return f"{counted(len(study.runs), 'run')}: {shown}; {counted(len(study.groups), 'row')}; objects: {objects}."


def write_tables(out: Path, record: Record, notes: Sequence[str]) -> list[Path]:
    """Writes all tables of a record as Markdown, with notes, and LaTeX."""
    return _write(out, {MARKDOWN: results_page(record, notes), LATEX: results_latex(record)})


def _write(out: Path, texts: dict[str, str]) -> list[Path]:
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_durably(out / name, text.encode("utf-8", errors="replace"))
    return [out / name for name in texts]


def csv_numbers(study: Study) -> str:
    """All figures at full precision and unscaled, one line per figure of every row; columns as in :data:`CSV_HEAD`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, CSV_HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for group in study.groups:
        for name in group.objects:
            for row in (group.method, *reference_rows([group], [name])):
                writer.writerows(_lines(study, group, name, row))
    return stream.getvalue()


def _lines(study: Study, group: Group, name: str, row: str) -> Iterator[dict[str, object]]:
    is_method = row == group.method
    line: dict[str, object] = {
        "row": group.label if is_method else f"{row} (with {group.label})",
        "kind": "method" if is_method else "reference", "object": name, **_sources(group, name),
    }  # fmt: skip
    entries = group.entries(name)
    if not entries:
        yield line | {"status": cell(group, name, "seen", "train", "l2").status}
    splits = study.splits(name)
    places = dict.fromkeys(
        (split, views, metric) for _, entry in entries for split, by_views in entry["rows"].get(row, {}).items()
        for views, cells in by_views.items() for metric in cells if split in splits
    )  # fmt: skip
    for split, views, metric in places:
        c, info = cell(group, name, split, views, metric, row=row), study.info(metric) or {}
        start, end = splits[split]
        line |= {"split": split, "first_frame": start, "end_frame": end, "views": views, "metric": metric}
        line |= {"status": c.status, "scale": info.get("scale", ""), "unit": info.get("unit", "")}
        found = c.value
        yield line if found is None else line | {
            "mean": found.mean, "std_sequences": found.std, "std_seeds": found.seed_std, "seeds": len(found.seeds)
        }  # fmt: skip


def _sources(group: Group, name: str) -> dict[str, str]:
    runs = [r for r, _ in group.entries(name)] or list(group.of(name))
    hashes = [run.data_hashes.get(name, ["?", "?"]) for run in runs]
    columns = {
        "runs": [r.name for r in runs], "config": [r.config_hash for r in runs], "commit": [r.commit for r in runs],
        "scene_sha256": [h[0] for h in hashes], "manifest_sha256": [h[1] for h in hashes],
    }  # fmt: skip
    return {key: ";".join(dict.fromkeys(column)) for key, column in columns.items()}
