"""Writer of reports: from directories of runs to HTML, Markdown, LaTeX and CSV files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gausim.io.files import write_durably
from gausim.report.gather.runs import find_runs
from gausim.report.gather.study import Study, make_study
from gausim.report.numbers import csv_numbers
from gausim.report.opening import Opening, make_openings
from gausim.report.pictures.media import Exhibit, object_figures
from gausim.report.render import Content, Sources, html_page, latex_tables, markdown_report
from gausim.report.tables.overview import make_sheets

PAGE, MARKDOWN, LATEX, NUMBERS = "report.html", "report.md", "tables.tex", "numbers.csv"


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
    texts = {
        PAGE: html_page(content),
        MARKDOWN: markdown_report(content),
        LATEX: latex_tables(content),
        NUMBERS: csv_numbers(study),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_durably(out / name, text.encode("utf-8", errors="replace"))
    return Report(study, openings, [out / name for name in texts])
