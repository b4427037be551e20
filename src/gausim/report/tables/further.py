"""Tables of the first bounce on a floor, and of errors by frames ahead."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import Any

from gausim.report.gather.runs import RunRecord, dig
from gausim.report.gather.study import Study, number
from gausim.report.tables.sheets import METHOD, MOTION, REFERENCE, Entry, Line, Sheet, seeds_entry
from gausim.results.curves import ERROR_3D
from gausim.results.table import BOUNCE_HEAD

_BOUNCE = (("height", 1.0, "{:.3f}"), ("height_error", 100.0, "{:.1f} %"), ("rise", 1.0, "{:.3f}"),
           ("rise_error", 100.0, "{:.1f} %"), ("depth", 1.0, "{:.2f}"))  # fmt: skip
_BOUNCE_CAPTION = (
    "Centre of the true points: its highest point above the floor after the first contact, and its rise from the "
    "lowest point before [scene units], with the mean of the relative errors over sequences."
)
_AHEAD_CAPTION = "3D error [% of diagonal] of the frame that is so many frames after the last one trained on."

Evaluated = tuple[RunRecord, dict[str, Any]]


def bounce_sheets(study: Study) -> list[Sheet]:
    """One table for each object that falls on a floor."""

    def columns(found: Sequence[Evaluated], row: str) -> tuple[Entry, ...]:
        return tuple(
            _entry(found, form, [_scaled(dig(e, "bounce", row, key), scale) for _, e in found])
            for key, scale, form in _BOUNCE
        )

    sheets = []
    for name in study.objects:
        lines = _lines(study, name, lambda entry: entry.get("bounce"), columns)
        if lines:
            head = (("", BOUNCE_HEAD),)
            sheets.append(
                Sheet(f"bounce_{name}", MOTION, f"How {name} bounces", _BOUNCE_CAPTION, head, lines, "method")
            )
    return sheets


def horizon_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known beyond the seen frames."""

    def columns(found: Sequence[Evaluated], row: str) -> tuple[Entry, ...]:
        series = [dig(e, "horizon", "rows", row, "points", ERROR_3D) or [] for _, e in found]
        return tuple(_entry(found, "{:.2f}", list(values)) for values in zip_longest(*series))

    sheets = []
    for name in study.objects:
        lines = _lines(study, name, _known_ahead, columns)
        if lines:
            entries = (e for group in study.groups for _, e in group.entries(name) if _known_ahead(e))
            heads = tuple(f"+{frames}" for frames in next(entries)["horizon"]["frames"])
            title = f"3D error of {name} by frames ahead"
            sheets.append(Sheet(f"horizon_{name}", MOTION, title, _AHEAD_CAPTION, (("", heads),), lines, "method"))
    return sheets


def _known_ahead(entry: dict[str, Any]) -> dict[str, Any]:
    rows = dig(entry, "horizon", "rows") or {}
    return {row: groups for row, groups in rows.items() if dig(groups, "points", ERROR_3D)}


def _lines(
    study: Study,
    name: str,
    rows_of: Callable[[dict[str, Any]], dict[str, Any] | None],
    columns: Callable[[Sequence[Evaluated], str], tuple[Entry, ...]],
) -> tuple[Line, ...]:
    """Lines of the methods, then of the first run's other rows."""
    lines, first = [], None
    for group in study.groups:
        found = [(run, entry) for run, entry in group.entries(name) if group.method in (rows_of(entry) or {})]
        if found:
            lines.append(Line(group.label, METHOD, columns(found, group.method)))
            first = first or found[0]
    if first is not None:
        methods = {group.method for group in study.groups}
        others = [row for row in rows_of(first[1]) or {} if row not in methods]
        lines += [Line(row, REFERENCE, columns([first], row)) for row in others]
    return tuple(lines)


def _entry(found: Sequence[Evaluated], form: str, values: Sequence[float | None]) -> Entry:
    return seeds_entry(values, form, runs=tuple(run for run, _ in found))


def _scaled(value: Any, scale: float) -> float | None:
    known = number(value)
    return None if known is None else known * scale
