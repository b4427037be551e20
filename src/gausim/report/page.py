"""The HTML page of a report: one file, no script, nothing from anywhere else."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from gausim.report.gather.study import Study
from gausim.report.opening import Opening, unanswered
from gausim.report.pictures.frames import FORESEEN, SEEN
from gausim.report.pictures.media import Exhibit
from gausim.report.sources import Sources
from gausim.report.tables.sheets import SECTIONS, Line, Sheet


def html_page(
    title: str,
    study: Study,
    sheets: Sequence[Sheet],
    sources: Sources,
    *,
    openings: Sequence[Opening],
    left: int = 0,
    exhibits: Sequence[tuple[str, list[Exhibit]]] = (),
    notes: Sequence[str] = (),
) -> str:
    """The page; every text is escaped, and its policy forbids the browser to load anything.

    Args:
        title: heading.
        study: what the report is about.
        sheets: tables.
        sources: where their numbers link to.
        openings: first screens, of which one is shown at a time.
        left: number of first screens that were left out.
        exhibits: pictures and videos by object.
        notes: what a reader must know.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(files("gausim.report").joinpath("page.html").read_text(encoding="utf-8"))
    sections = [(name, [_sheet(sheet, sources) for sheet in sheets if sheet.section == name]) for name in SECTIONS]
    return template.render(
        title=title,
        summary=summary_line(study),
        openings=list(openings),
        left=left,
        remedies=unanswered(study),
        notes=list(notes),
        sections=[(name, own) for name, own in sections if own and openings],
        exhibits=[(name, figures) for name, figures in exhibits if figures],
        seen_color=_rgb(SEEN),
        foreseen_color=_rgb(FORESEEN),
        sets=list(sources.sets.items()),
        names={anchor: source.name for anchor, source in sources.by_anchor().items()},
        runs=sources.runs,
    )


def _rgb(color: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def summary_line(study: Study) -> str:
    """How many runs there are, and in what state."""
    states: dict[str, int] = {}
    for run in study.runs:
        states[run.status] = states.get(run.status, 0) + 1
    shown = ", ".join(f"{count} {state}" for state, count in states.items())
    objects = ", ".join(study.objects) or "none"
    return f"{_counted(len(study.runs), 'run')}: {shown}; {_counted(len(study.groups), 'row')}; objects: {objects}."


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


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
