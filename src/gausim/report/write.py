"""Writer of reports: from directories of runs to HTML, Markdown, LaTeX and CSV files."""

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
from gausim.report.layouts import SECTIONS, grids
from gausim.report.media import error_curves
from gausim.report.opening import Opening, make_openings, unanswered
from gausim.report.render import grouped, results_latex, results_page
from gausim.report.runs import RunRecord, find_runs
from gausim.report.study import Study, counted, make_study
from gausim.results.pivot import Grid, cell_texts
from gausim.results.table import METHOD, PAPER, Made

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


def write_report(
    roots: Sequence[Path],
    out: Path,
    *,
    title: str = "Report",
    pictures: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> Report:
    """Writes the report of all runs at or below ``roots`` to ``out``, which is not searched for runs.

    ``pictures``: whether the page has figures and films. ``say`` is called with messages on the progress.

    Raises:
        RunError: a root is no directory, or there is no run.
    """
    study = make_study(find_runs(roots, skip=out), title)
    tables = grids(study)
    if pictures:
        say("films of the runs")
    openings, left = make_openings(study, pictures=pictures)
    exhibits, notes = [], list(study.notes)
    for name in study.objects if pictures else ():
        say(f"pictures of {name}")
        uri, problems = error_curves(study, name)
        exhibits += [(name, uri)] if uri else []
        notes += [f"{name}: {problem}" for problem in dict.fromkeys(problems)]
    links = {run: quote(Path(os.path.relpath(run.path.resolve(), out.resolve())).as_posix()) for run in study.runs}
    pages = {run: f"{link}/{PAGE_TO_PULL}" for run, link in links.items() if (run.path / PAGE_TO_PULL).is_file()}
    rows = {run: [group.label for group in study.groups if run in group.runs] for run in study.runs}
    shown = {"left": left, "links": links, "pages": pages, "rows": rows, "exhibits": exhibits, "notes": notes}
    made = study.results.made or Made("unknown")
    files = {
        PAGE: _page(study, tables, openings, **shown),
        NUMBERS: csv_numbers(study),
        MARKDOWN: results_page(study.results.title, made, tables, notes),
        LATEX: results_latex(made, tables),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_durably(out / name, text.encode("utf-8", errors="replace"))
    return Report(study, openings, [out / name for name in files])


def _page(study: Study, tables: Sequence[Grid], openings: Sequence[Opening], **content: object) -> str:
    """The page: one HTML file without scripts or external resources, all texts escaped.

    ``openings`` are first screens, shown one at a time; ``content`` are further names of the template.
    """
    sections = [(name, [grid for grid in tables if grid.section == name]) for name in SECTIONS]
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
    )


def summary_line(study: Study) -> str:
    """Number of runs, by state."""
    states = Counter(run.status for run in study.runs)
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    objects = ", ".join(study.objects) or "none"
    return f"{counted(len(study.runs), 'run')}: {shown}; {counted(len(study.groups), 'row')}; objects: {objects}."


def csv_numbers(study: Study) -> str:
    """The long table at full precision, a line per seed, and a line for every row without figures."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, CSV_HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    # The figures of a method come from all its seeds, those of a reference from the first run of the object.
    sources = {(group.label, name): _sources([run for run, _ in group.entries(name)] or group.of(name), name)
               for group in study.groups for name in group.objects}  # fmt: skip
    first = {name: _sources([run for group in study.groups for run, _ in group.entries(name)][:1], name)
             for name in study.results.objects}  # fmt: skip
    for entry in study.results.table:
        own = {name: getattr(entry, name) for name in CSV_HEAD[:9]}
        made = {} if entry.kind == PAPER else sources.get((entry.row, entry.object), first[entry.object])
        unit = study.results.metrics[entry.metric].unit
        writer.writerow(spreadsheet_cells({**own, "unit": unit, **made}))
    for group in study.groups:
        for name in filter(group.state, group.objects):
            status = {"row": group.label, "kind": METHOD, "object": name, "status": group.state(name)}
            writer.writerow(spreadsheet_cells({**status, **sources[group.label, name]}))
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
