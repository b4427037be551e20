"""Figures of how predictions oscillate beside the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gausim.report.gather.diagnosis import Diagnosis, read_diagnosis
from gausim.report.pictures.figures import METHOD_COLORS, SEEN_SHADE, save_figure
from gausim.results.curves import TRUTH

_DPI = 110
_GREYS = ("#777777", "#aaaaaa")


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
