"""Figures of the oscillation of predictions and truth, and of long rollouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gausim.report.gather.diagnosis import Diagnosis, numbers, read_diagnosis
from gausim.report.pictures.figures import METHOD_COLORS, SEEN_SHADE, made_figure, save_figure
from gausim.results.curves import TRUTH

_GREYS = ("#777777", "#aaaaaa")


def diagnosis_plot(named: Sequence[tuple[str, Diagnosis, str]], *, title: str) -> Figure:
    """Spectra and phase errors of the truth and of predictions: label, diagnosis and row in it of each."""
    figure, (power, phase) = made_figure(1, 2, (10.4, 3.8), title)
    first = named[0][1]
    shown = {row for _, _, row in named}
    others = [r for r in first.rows if r != TRUTH and r not in shown]
    lines = [(TRUTH, first, TRUTH, "-", "black", 1.6)]
    lines += [(*item, "-", color, 1.4) for color, item in zip(METHOD_COLORS * len(named), named, strict=False)]
    lines += [(row, first, row, ":", color, 1.1) for color, row in zip(_GREYS, others, strict=False)]
    for label, diagnosis, row, style, color, width in lines:
        motion = diagnosis.rows[row]
        spectrum = numbers(motion.spectrum)
        positive = np.where(spectrum > 0, spectrum, np.nan)
        power.semilogy(diagnosis.frequency, positive, style, color=color, linewidth=width, label=label)
        if row != TRUTH:
            phase.plot(numbers(motion.phase_error), style, color=color, linewidth=width)
    phase.axvspan(-0.5, first.first_unseen - 0.5, color=SEEN_SHADE, linewidth=0, zorder=0)
    # The page disables formulas, which the default labels contain.
    power.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0e}"))
    power.set(title="power of the motion", xlabel="frequency [Hz]", ylabel="squared displacement per Hz")
    phase.set(title="phase error [degrees]", xlabel="frame (shaded: seen)", ylim=(0, 130))
    phase.axhline(180 / np.sqrt(3), color="#999999", linewidth=0.8)
    phase.text(1, 180 / np.sqrt(3) + 2, "unrelated", fontsize=7, color="#777777")
    handles, labels = power.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)), fontsize=8)
    return figure


def diagnosis_figure(name: str, entry: Mapping[str, Any], path: Path) -> bool:
    """Writes the figure of one evaluation; returns False if it has no diagnosis."""
    found = read_diagnosis(entry)
    methods = [m for m in entry.get("methods", []) if found is not None and m in found.rows]
    if found is None or not methods:
        return False
    save_figure(diagnosis_plot([(m, found, m) for m in methods], title=f"{name}: motion beside the truth"), path)
    return True


def endurance_figure(name: str, rollouts: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Motion energy and distance from rest over the frames of every rollout of ``endurance.json``.

    A rollout has ``window`` [frames], and ``energy`` and ``away`` per window.
    """
    figure, (left, right) = made_figure(1, 2, (9.6, 3.4), f"{name}, far beyond the recording")
    for color, (kind, told) in zip(METHOD_COLORS, rollouts.items(), strict=False):
        frames = (np.arange(len(told["energy"])) + 0.5) * told["window"]
        left.semilogy(frames, np.maximum(told["energy"], 1e-30), color=color, label=kind)
        right.plot(frames, 100 * np.asarray(told["away"]), color=color, label=kind)
    left.set(title="motion energy", xlabel="frame")
    right.set(title="mean distance from rest [% of diagonal]", xlabel="frame", ylim=(0, None))
    right.legend(fontsize=8)
    save_figure(figure, path)
