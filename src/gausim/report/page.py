"""The HTML page of a report: one file, no script, nothing from anywhere else."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from gausim.report.media import Exhibit
from gausim.report.sheets import Line, Sheet
from gausim.report.sources import Sources
from gausim.report.study import Study


def html_page(
    title: str,
    study: Study,
    sheets: Sequence[Sheet],
    sources: Sources,
    exhibits: Sequence[tuple[str, list[Exhibit]]],
    notes: Sequence[str],
) -> str:
    """The page; every text is escaped, and its policy forbids the browser to load anything.

    Args:
        title: heading.
        study: what the report is about.
        sheets: tables.
        sources: where their numbers link to.
        exhibits: pictures and videos by object.
        notes: what a reader must know.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(files("gausim.report").joinpath("page.html").read_text(encoding="utf-8"))
    return template.render(
        title=title,
        summary=summary_line(study),
        notes=list(notes),
        sheets=[_sheet(sheet, sources) for sheet in sheets],
        exhibits=list(exhibits),
        sets=list(sources.sets.items()),
        names={anchor: source.name for anchor, source in sources.by_anchor().items()},
        runs=sources.runs,
    )


def summary_line(study: Study) -> str:
    """How many runs there are, and in what state."""
    states: dict[str, int] = {}
    for run in study.runs:
        states[run.status] = states.get(run.status, 0) + 1
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    return f"{len(study.runs)} runs: {shown}; {len(study.groups)} rows; objects: {', '.join(study.objects) or 'none'}."


def _sheet(sheet: Sheet, sources: Sources) -> dict[str, Any]:
    before: list[Line | None] = [None, *sheet.lines[:-1]]
    lines = [
        {
            "label": line.label,
            "kind": line.kind,
            "begins": last is not None and last.kind != line.kind,
            "entries": [
                {
                    "text": e.text,
                    "extra": e.extra,
                    "best": e.best,
                    "missing": e.missing,
                    "anchor": sources.anchor(e.runs),
                }
                for e in line.entries
            ],
        }
        for last, line in zip(before, sheet.lines, strict=True)
    ]
    return {
        "title": sheet.title,
        "caption": sheet.caption,
        "columns": sheet.columns,
        "has_groups": any(group for group, _ in sheet.columns),
        "stub": sheet.stub,
        "lines": lines,
    }
