"""Tables of motion: first bounce on a floor, errors by frames ahead, and oscillation beside the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import Any

from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import Study, number
from gausim.report.tables.sheets import METHOD, MOTION, REFERENCE, Line, Sheet, seeds_entry
from gausim.results.curves import ERROR_3D, TRUTH
from gausim.results.diagnosis import read_diagnosis
from gausim.results.summary import dig
from gausim.results.table import BOUNCE

Rows = dict[str, Sequence[float | None]]
# Headings of columns and formats of their figures, and the figures of every row.
Figures = tuple[Sequence[tuple[str, str]], Rows]

_BOUNCE_CAPTION = (
    "Centre of the true points: its highest point above the floor after the first contact, and its rise from the "
    "lowest point before [scene units], with the mean of the relative errors over sequences."
)
_AHEAD_CAPTION = "3D error [% of diagonal] of the frame that is so many frames after the last one trained on."
_OSCILLATION = (
    ("first velocity, cosine", "{:.2f}"), ("frequency error", "{:.1f} %"), ("damping / true", "{:.2f}"),
    ("phase error, seen", "{:.0f}°"), ("phase error, unseen", "{:.0f}°"), ("error, large parts", "{:.2f}"),
    ("error, small parts", "{:.2f}"),
)  # fmt: skip
_OSCILLATION_CAPTION = (
    "In the principal motions of the true points, weighted by their fraction of the squared displacement. Frequency "
    "and damping: of the oscillation z(t+1) = a z(t) + b z(t-1) that fits all frames best. Phase: root mean square "
    "over motions of the analytic signals' difference; unrelated motions have 104 degrees. A damping ratio above 1 "
    "with small phase errors tells a motion that dies away in step; below 1 with large ones, a motion out of step. "
    "Parts: units of the coarsest and the finest level of the hierarchy, their centres' error over that of rest, in "
    "all frames."
)


def bounces(entry: dict[str, Any]) -> Rows:
    """The first bounces of an object's entry, in the columns of :data:`gausim.results.table.BOUNCE`, scaled."""

    def scaled(value: float | None, scale: float) -> float | None:
        return None if value is None else scale * value

    found = entry.get("bounce") or {}
    return {row: [scaled(number(own.get(f.key)), f.scale) for f in BOUNCE] for row, own in found.items()}


def frames_ahead(entry: dict[str, Any]) -> list[int]:
    """The frames after the last seen one of which an object's entry has errors."""
    return dig(entry, "horizon", "frames") or []


def errors_ahead(entry: dict[str, Any]) -> Rows:
    """The 3D errors of an object's entry in these frames, where the true motion is known."""
    found, count = dig(entry, "horizon", "rows") or {}, len(frames_ahead(entry))
    return {row: errors[:count] for row, groups in found.items() if (errors := dig(groups, "points", ERROR_3D))}


def bounce_sheets(study: Study) -> list[Sheet]:
    """One table for each object that falls on a floor."""
    columns = [(figure.head, f"{{:.{figure.digits}f}}{figure.sign}") for figure in BOUNCE]
    return _sheets(study, "bounce", "How {} bounces", _BOUNCE_CAPTION, lambda entry: (columns, bounces(entry)))


def horizon_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known beyond the seen frames."""

    def read(entry: dict[str, Any]) -> Figures:
        return [(f"+{n}", "{:.2f}") for n in frames_ahead(entry)], errors_ahead(entry)

    return _sheets(study, "horizon", "3D error of {} by frames ahead", _AHEAD_CAPTION, read)


def diagnosis_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known."""

    def read(entry: dict[str, Any]) -> Figures:
        found = read_diagnosis(entry)
        if found is None:
            return _OSCILLATION, {}
        rows: Rows = {}
        for row, motion in found.rows.items():
            if row != TRUTH:
                levels = motion.level_errors or [None]
                rows[row] = (
                    motion.velocity_cosine, 100 * found.frequency_error(row), found.damping_ratio(row),
                    found.phase(row, seen=True), found.phase(row, seen=False), levels[-1], levels[0],
                )  # fmt: skip
        return _OSCILLATION, rows

    return _sheets(study, "motion", "How {} moves", _OSCILLATION_CAPTION, read)


def _sheets(study: Study, key: str, title: str, caption: str, read: Callable[[dict[str, Any]], Figures]) -> list[Sheet]:
    """Per object with figures the methods over their seeds, then the first run's other rows."""
    methods = {group.method for group in study.groups}
    sheets = []
    for name in study.objects:
        lines, first = [], None
        for group in study.groups:
            entries = [(run, *read(entry)) for run, entry in group.entries(name)]
            found = [item for item in entries if group.method in item[2]]
            if found:
                lines.append(_line(group.label, METHOD, found, group.method))
                first = first or found[0]
        if first is not None:
            lines += [_line(row, REFERENCE, [first], row) for row in first[2] if row not in methods]
            heads = (("", tuple(head for head, _ in first[1])),)
            sheets.append(Sheet(f"{key}_{name}", MOTION, title.format(name), caption, heads, tuple(lines), "method"))
    return sheets


def _line(label: str, kind: str, found: Sequence[tuple[RunRecord, Sequence[tuple[str, str]], Rows]], row: str) -> Line:
    """A row over the seeds; ``found`` are the runs with their :data:`Figures`."""
    runs = tuple(run for run, _, _ in found)
    columns = zip(found[0][1], zip_longest(*(rows[row] for _, _, rows in found)), strict=False)
    return Line(label, kind, tuple(seeds_entry(values, form, runs=runs) for (_, form), values in columns))
