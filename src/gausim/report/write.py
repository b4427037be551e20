"""Writer of reports: from directories of runs to HTML, Markdown, LaTeX and CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gausim.io.files import write_durably
from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import Group, Study, cell, make_study
from gausim.report.opening import Opening, make_openings
from gausim.report.pictures.media import Exhibit, object_figures
from gausim.report.records.measure import measured_record
from gausim.report.records.print import results_latex, results_page
from gausim.report.records.record import Record
from gausim.report.render import Content, Sources, html_page
from gausim.report.tables.overview import make_sheets

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
    sources = Sources(runs, sheets, out)
    if pictures:
        say("videos of the runs")
    openings, left = make_openings(study, pictures=pictures)
    exhibits: list[tuple[str, list[Exhibit]]] = []
    notes = list(study.notes)
    for name in study.objects if pictures else ():
        say(f"pictures of {name}")
        figures, problems = object_figures(study, name)
        exhibits.append((name, figures))
        notes += [f"{name}: {problem}" for problem in dict.fromkeys(problems)]
    content = Content(title, study, sheets, sources, openings, left, exhibits, notes)
    record = measured_record(study, title)
    written = _write(out, {PAGE: html_page(content), NUMBERS: csv_numbers(study)})
    return Report(study, openings, [*written, *write_tables(out, record, notes)])


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
            rows = {str(row): e["methods"] for _, e in group.entries(name) for row in e["rows"]}
            for row in [group.method, *(r for r, methods in rows.items() if r not in methods)]:
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
        figures: dict[str, object] = {}
        if c.value is not None:
            figures = {"mean": c.value.mean, "std_sequences": c.value.std, "std_seeds": c.value.seed_std}
            figures["seeds"] = c.value.seeds
        yield line | figures


def _sources(group: Group, name: str) -> dict[str, str]:
    runs = [r for r, _ in group.entries(name)] or list(group.of(name))
    hashes = [run.data_hashes.get(name, ("?", "?")) for run in runs]
    columns = {
        "runs": [r.name for r in runs], "config": [r.config_hash for r in runs], "commit": [r.commit for r in runs],
        "scene_sha256": [h[0] for h in hashes], "manifest_sha256": [h[1] for h in hashes],
    }  # fmt: skip
    return {key: ";".join(dict.fromkeys(column)) for key, column in columns.items()}
