"""Tables and figures of how predictions oscillate beside the truth (``diagnosis`` in metrics.json)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gausim.report.curves import TRUTH
from gausim.report.figures import METHOD_COLORS, SEEN_SHADE, save_figure
from gausim.report.runs import RunRecord
from gausim.report.sheets import METHOD, MOTION, NOTHING, REFERENCE, Entry, Line, Sheet
from gausim.report.study import Study, deviation, number

_DPI = 110
_GREYS = ("#777777", "#aaaaaa")


@dataclass(frozen=True, eq=False)
class Motion:
    """How one row moves.

    Attributes:
        spectrum: power per frequency.
        frequencies: of each principal motion [Hz]; NaN where unknown.
        dampings: share of critical; NaN where it does not oscillate.
        phase_error: per frame [degrees]; empty for the truth.
        cosine: of the first velocity to the true one; NaN for the truth.
        levels: error over the static prediction's of the units of each level, the small ones first; empty where there
            is no hierarchy.
    """

    spectrum: np.ndarray
    frequencies: np.ndarray
    dampings: np.ndarray
    phase_error: np.ndarray
    cosine: float
    levels: np.ndarray

    @property
    def small(self) -> float:
        """Error of the smallest units; NaN without a hierarchy."""
        return float(self.levels[0]) if len(self.levels) else float("nan")

    @property
    def large(self) -> float:
        """Error of the largest units; NaN without a hierarchy."""
        return float(self.levels[-1]) if len(self.levels) else float("nan")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is known of the motions of one object.

    Attributes:
        share: of the squared displacement in each principal motion.
        frequency: of the spectra [Hz].
        first_unseen: first frame that training did not see.
        rows: the truth and the predictions.
    """

    share: np.ndarray
    frequency: np.ndarray
    first_unseen: int
    rows: Mapping[str, Motion]

    def frequency_error(self, row: str) -> float:
        """Mean over principal motions, weighted by their share, of the relative error of the frequency."""
        found, true = self.rows[row].frequencies, self.rows[TRUTH].frequencies
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._mean(np.where(true > 0, np.abs(found / true - 1), np.nan))

    def damping_ratio(self, row: str) -> float:
        """Predicted over true damping, both as weighted means over the principal motions that oscillate in both."""
        found, true = self.rows[row].dampings, self.rows[TRUTH].dampings
        both = np.isfinite(found) & np.isfinite(true)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(self._mean(np.where(both, found, np.nan)) / self._mean(np.where(both, true, np.nan)))

    def phase(self, row: str, *, seen: bool) -> float:
        """Mean phase error of the seen or the unseen frames [degrees]."""
        values = self.rows[row].phase_error
        return _nanmean(values[: self.first_unseen] if seen else values[self.first_unseen :])

    def _mean(self, values: np.ndarray) -> float:
        known = np.isfinite(values)
        total = float(self.share[known].sum())
        return float((self.share[known] * values[known]).sum() / total) if total > 0 else float("nan")


def read_diagnosis(entry: Mapping[str, Any]) -> Diagnosis | None:
    """The diagnosis of an object's entry in metrics.json; None where there is none that makes sense."""
    found, splits = entry.get("diagnosis"), entry.get("splits")
    if not isinstance(found, dict) or not isinstance(found.get("rows"), dict) or not isinstance(splits, dict):
        return None
    share, frequency, seen = _numbers(found.get("share")), _numbers(found.get("frequency")), splits.get("seen")
    rows = {str(k): _motion(v, len(share), len(frequency)) for k, v in found["rows"].items() if isinstance(v, dict)}
    known = {name: motion for name, motion in rows.items() if motion is not None}
    if TRUTH not in known or not isinstance(seen, list) or len(seen) != 2 or not isinstance(seen[1], int):
        return None
    return Diagnosis(share, frequency, seen[1], known)


def _motion(row: Mapping[str, Any], motions: int, bins: int) -> Motion | None:
    power, frequencies, dampings = (_numbers(row.get(key)) for key in ("spectrum", "frequencies", "dampings"))
    if not bins or not motions or (len(power), len(frequencies), len(dampings)) != (bins, motions, motions):
        return None
    cosine = number(row.get("velocity_cosine"))
    phase = _numbers(row.get("phase_error"))
    levels = _numbers(row.get("level_errors"))
    return Motion(power, frequencies, dampings, phase, float("nan") if cosine is None else cosine, levels)


def _numbers(values: Any) -> np.ndarray:
    found = [number(v) for v in values] if isinstance(values, list) else []
    return np.array([np.nan if v is None else v for v in found], float)


def _nanmean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def diagnosis_sheets(study: Study) -> list[Sheet]:
    """One table per object whose true motion is known."""
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
    "In the principal motions of the true points, weighted by their share of the squared displacement. Frequency and "
    "damping: of the oscillation z(t+1) = a z(t) + b z(t-1) that fits all frames best. Phase: root mean square over "
    "motions of the analytic signals' difference; unrelated motions have 104 degrees. A damping ratio above 1 with "
    "small phase errors tells a motion that dies away in step; below 1 with large ones, a motion out of step. "
    "Parts: units of the coarsest and the finest level of the hierarchy, their centres' error over that of rest, in "
    "all frames."
)


def _entries(found: Sequence[tuple[RunRecord, Diagnosis]], row: str) -> tuple[Entry, ...]:
    runs = tuple(run for run, _ in found)
    columns = (
        ([d.rows[row].cosine for _, d in found], "{:.2f}", 1.0),
        ([d.frequency_error(row) for _, d in found], "{:.1f} %", 100.0),
        ([d.damping_ratio(row) for _, d in found], "{:.2f}", 1.0),
        ([d.phase(row, seen=True) for _, d in found], "{:.0f}°", 1.0),
        ([d.phase(row, seen=False) for _, d in found], "{:.0f}°", 1.0),
        ([d.rows[row].large for _, d in found], "{:.2f}", 1.0),
        ([d.rows[row].small for _, d in found], "{:.2f}", 1.0),
    )
    entries = []
    for values, form, scale in columns:
        known = [scale * v for v in values if np.isfinite(v)]
        spread = deviation(known)
        extra = f"± {form.format(spread)}, {len(known)} seeds" if spread is not None else ""
        text = form.format(sum(known) / len(known)) if known else NOTHING
        entries.append(Entry(text, extra, missing=not known, runs=runs))
    return tuple(entries)


def diagnosis_plot(named: Sequence[tuple[str, Diagnosis, str]], *, title: str) -> Figure:
    """Spectra and phase errors of several predictions beside the truth.

    Args:
        named: label, diagnosis and row in it of each prediction.
        title: heading.
    """
    figure = Figure(figsize=(10.4, 3.8), dpi=_DPI, layout="constrained")
    power, phase = figure.subplots(1, 2)
    first = named[0][1]
    power.semilogy(first.frequency, _positive(first.rows[TRUTH].spectrum), color="black", linewidth=1.6, label=TRUTH)
    for color, (label, diagnosis, row) in zip(METHOD_COLORS * len(named), named, strict=False):
        motion = diagnosis.rows[row]
        power.semilogy(diagnosis.frequency, _positive(motion.spectrum), color=color, linewidth=1.4, label=label)
        phase.plot(motion.phase_error, color=color, linewidth=1.4)
    shown = {row for _, _, row in named}
    for color, row in zip(_GREYS, [r for r in first.rows if r != TRUTH and r not in shown], strict=False):
        power.semilogy(first.frequency, _positive(first.rows[row].spectrum), ":", color=color, linewidth=1.1, label=row)
        phase.plot(first.rows[row].phase_error, ":", color=color, linewidth=1.1)
    phase.axvspan(-0.5, first.first_unseen - 0.5, color=SEEN_SHADE, linewidth=0, zorder=0)
    # The page turns formulas off, and so would print those of the default labels.
    power.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0e}"))
    power.set(title="power of the motion", xlabel="frequency [Hz]", ylabel="squared displacement per Hz")
    phase.set(title="phase error [degrees]", xlabel="frame (shaded: seen)", ylim=(0, 130))
    phase.axhline(180 / np.sqrt(3), color="#999999", linewidth=0.8)
    phase.text(1, 180 / np.sqrt(3) + 2, "unrelated", fontsize=7, color="#777777")
    handles, labels = power.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)), fontsize=8)
    figure.suptitle(title, fontsize=10)
    return figure


def _positive(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, np.nan)


def diagnosis_figure(name: str, entry: Mapping[str, Any], path: Path) -> bool:
    """Writes the figure of one evaluation; returns whether there was something to show."""
    found = read_diagnosis(entry)
    methods = [m for m in entry.get("methods", []) if found is not None and m in found.rows]
    if found is None or not methods:
        return False
    save_figure(diagnosis_plot([(m, found, m) for m in methods], title=f"{name}: motion beside the truth"), path)
    return True
