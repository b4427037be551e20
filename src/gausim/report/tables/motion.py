"""Tables of motion: first bounce on a floor, errors by frames ahead, and oscillation beside the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from typing import Any

from gausim.report.gather.diagnosis import read_diagnosis
from gausim.report.gather.runs import dig
from gausim.report.gather.study import Study, number
from gausim.report.tables.sheets import METHOD, MOTION, REFERENCE, Line, Sheet, seeds_entry
from gausim.results.curves import ERROR_3D, TRUTH
from gausim.results.table import BOUNCE_HEAD

# Columns of a table: the figure of every seed, and its form.
Columns = Sequence[tuple[Sequence[float | None], str]]

_BOUNCE = (("height", 1.0, "{:.3f}"), ("height_error", 100.0, "{:.1f} %"), ("rise", 1.0, "{:.3f}"),
           ("rise_error", 100.0, "{:.1f} %"), ("depth", 1.0, "{:.2f}"))  # fmt: skip
_BOUNCE_CAPTION = (
    "Centre of the true points: its highest point above the floor after the first contact, and its rise from the "
    "lowest point before [scene units], with the mean of the relative errors over sequences."
)
_AHEAD_CAPTION = "3D error [% of diagonal] of the frame that is so many frames after the last one trained on."
_OSCILLATION = (
    "first velocity, cosine", "frequency error", "damping / true", "phase error, seen", "phase error, unseen",
    "error, large parts", "error, small parts",
)  # fmt: skip
_OSCILLATION_CAPTION = (
    "In the principal motions of the true points, weighted by their fraction of the squared displacement. Frequency "
    "and damping: of the oscillation z(t+1) = a z(t) + b z(t-1) that fits all frames best. Phase: root mean square "
    "over motions of the analytic signals' difference; unrelated motions have 104 degrees. A damping ratio above 1 "
    "with small phase errors tells a motion that dies away in step; below 1 with large ones, a motion out of step. "
    "Parts: units of the coarsest and the finest level of the hierarchy, their centres' error over that of rest, in "
    "all frames."
)


def bounce_sheets(study: Study) -> list[Sheet]:
    """One table for each object that falls on a floor."""

    def columns(found: Sequence[Any]) -> Columns:
        return [([_scaled(row.get(key), scale) for row in found], form) for key, scale, form in _BOUNCE]

    def read(entry: dict[str, Any]) -> dict[str, Any]:
        return entry.get("bounce") or {}

    return list(_sheets(study, "bounce", "How {} bounces", _BOUNCE_CAPTION, read, columns, lambda row: BOUNCE_HEAD))


def horizon_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known beyond the seen frames."""

    def read(entry: dict[str, Any]) -> dict[str, Any]:
        rows = {r: dig(groups, "points", ERROR_3D) for r, groups in (dig(entry, "horizon", "rows") or {}).items()}
        frames = dig(entry, "horizon", "frames")
        return {row: dict(zip(frames, errors, strict=True)) for row, errors in rows.items() if errors}

    def columns(found: Sequence[Any]) -> Columns:
        return [(values, "{:.2f}") for values in zip_longest(*(row.values() for row in found))]

    title = "3D error of {} by frames ahead"
    return list(_sheets(study, "horizon", title, _AHEAD_CAPTION, read, columns, lambda row: [f"+{n}" for n in row]))


def diagnosis_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known."""

    def read(entry: dict[str, Any]) -> dict[str, Any]:
        found = read_diagnosis(entry)
        return {} if found is None else {row: (found, row) for row in found.rows if row != TRUTH}

    def columns(found: Sequence[Any]) -> Columns:
        motions = [d.rows[row] for d, row in found]
        levels = [m.level_errors for m in motions if m.level_errors]
        return (
            ([m.velocity_cosine for m in motions], "{:.2f}"),
            ([100 * d.frequency_error(row) for d, row in found], "{:.1f} %"),
            ([d.damping_ratio(row) for d, row in found], "{:.2f}"),
            ([d.phase(row, seen=True) for d, row in found], "{:.0f}°"),
            ([d.phase(row, seen=False) for d, row in found], "{:.0f}°"),
            ([errors[-1] for errors in levels], "{:.2f}"),
            ([errors[0] for errors in levels], "{:.2f}"),
        )

    return list(_sheets(study, "motion", "How {} moves", _OSCILLATION_CAPTION, read, columns, lambda row: _OSCILLATION))


def _sheets(
    study: Study,
    key: str,
    title: str,
    caption: str,
    read: Callable[[dict[str, Any]], dict[str, Any]],
    columns: Callable[[Sequence[Any]], Columns],
    heads: Callable[[Any], Sequence[str]],
) -> Iterator[Sheet]:
    """Per object with figures the methods, then the first run's other rows; ``read`` gives those of an entry."""
    methods = {group.method for group in study.groups}

    def line(label: str, kind: str, found: Sequence[tuple[Any, dict[str, Any]]], row: str) -> Line:
        runs, told = tuple(run for run, _ in found), columns([rows[row] for _, rows in found])
        return Line(label, kind, tuple(seeds_entry(values, form, runs=runs) for values, form in told))

    for name in study.objects:
        lines, first = [], None
        for group in study.groups:
            entries = [(run, read(entry)) for run, entry in group.entries(name)]
            found = [item for item in entries if group.method in item[1]]
            if found:
                lines.append(line(group.label, METHOD, found, group.method))
                first = first or found[0]
        if first is not None:
            lines += [line(row, REFERENCE, [first], row) for row in first[1] if row not in methods]
            head = (("", tuple(heads(next(iter(first[1].values()))))),)
            yield Sheet(f"{key}_{name}", MOTION, title.format(name), caption, head, tuple(lines), "method")


def _scaled(value: Any, scale: float) -> float | None:
    known = number(value)
    return None if known is None else known * scale
