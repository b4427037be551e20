"""Tables of the oscillation of predictions and truth."""

from __future__ import annotations

from collections.abc import Sequence

from gausim.report.gather.diagnosis import Diagnosis, read_diagnosis
from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import Study
from gausim.report.tables.sheets import METHOD, MOTION, REFERENCE, Entry, Line, Sheet, seeds_entry
from gausim.results.curves import TRUTH


def diagnosis_sheets(study: Study) -> list[Sheet]:
    """One table for each object whose true motion is known."""
    sheets = []
    for name in study.objects:
        lines, reference = [], None
        for group in study.groups:
            found = [(run, d) for run, entry in group.entries(name) if (d := read_diagnosis(entry)) is not None]
            own = [(run, d) for run, d in found if group.method in d.rows]
            if own:
                lines.append(Line(group.label, METHOD, _entries(own, group.method)))
                reference = reference or (own[0], {g.method for g in study.groups})
        if reference is not None:
            (run, first), methods = reference
            others = [row for row in first.rows if row != TRUTH and row not in methods]
            lines += [Line(row, REFERENCE, _entries([(run, first)], row)) for row in others]
            title = f"How {name} moves"
            sheets.append(Sheet(f"motion_{name}", MOTION, title, _CAPTION, (("", _HEADS),), tuple(lines), "method"))
    return sheets


_HEADS = (
    "first velocity, cosine", "frequency error", "damping / true", "phase error, seen", "phase error, unseen",
    "error, large parts", "error, small parts",
)  # fmt: skip
_CAPTION = (
    "In the principal motions of the true points, weighted by their fraction of the squared displacement. Frequency "
    "and damping: of the oscillation z(t+1) = a z(t) + b z(t-1) that fits all frames best. Phase: root mean square "
    "over motions of the analytic signals' difference; unrelated motions have 104 degrees. A damping ratio above 1 "
    "with small phase errors tells a motion that dies away in step; below 1 with large ones, a motion out of step. "
    "Parts: units of the coarsest and the finest level of the hierarchy, their centres' error over that of rest, in "
    "all frames."
)


def _entries(found: Sequence[tuple[RunRecord, Diagnosis]], row: str) -> tuple[Entry, ...]:
    motions = [d.rows[row] for _, d in found]
    columns = (
        ([m.velocity_cosine for m in motions], "{:.2f}"),
        ([100 * d.frequency_error(row) for _, d in found], "{:.1f} %"),
        ([d.damping_ratio(row) for _, d in found], "{:.2f}"),
        ([d.phase(row, seen=True) for _, d in found], "{:.0f}°"),
        ([d.phase(row, seen=False) for _, d in found], "{:.0f}°"),
        ([m.level_errors[-1] for m in motions if m.level_errors], "{:.2f}"),
        ([m.level_errors[0] for m in motions if m.level_errors], "{:.2f}"),
    )
    return tuple(seeds_entry(values, form, runs=tuple(run for run, _ in found)) for values, form in columns)
