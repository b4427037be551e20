"""Figures of results: errors over time, space-time slices, contact sheets, oscillation, long rollouts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter

from gausim.io.files import replacing
from gausim.pictures.frames import error_colors, moving_line, space_time_slice
from gausim.results.curves import ERROR_3D, TRUTH, ObjectCurves
from gausim.results.diagnosis import DiagnosisFigures, numbers, read_diagnosis
from gausim.results.table import ObjectInfo

_DPI = 110
SEEN_SHADE = "#dde6ee"
METHOD_COLORS = ("#c2410c", "#1d4ed8", "#15803d", "#7e22ce", "#0e7490", "#a16207", "#be185d", "#4d7c0f")
_REFERENCE_COLORS = ("#555555", "#999999", "#bbbbbb")
_GREYS = ("#777777", "#aaaaaa")
# Labels, each with evaluations (seeds) and the name of their row.
Rows = Sequence[tuple[str, Sequence[tuple[ObjectCurves, str]]]]


def error_figure(curves: ObjectCurves, path: Path, *, sequence: str | None = None) -> None:
    """Writes the errors over time of one sequence, or their mean over all sequences."""
    facts = curves.facts
    title = f"{facts.name}, {sequence or f'mean over {len(facts.sequences)} sequences'}"
    save_figure(error_plot([(row, [(curves, row)]) for row in curves.rows], title=title, sequence=sequence), path)


def error_plot(rows: Rows, *, title: str = "", sequence: str | None = None) -> Figure:
    """Errors over time of every row: 3D if the truth is known, then l2 in the training and held-out views.

    The mean and, for methods, a band of one standard deviation are over all evaluations of a row, and over all
    sequences unless one is named.
    """
    first = rows[0][1][0][0]
    panels = [("l2", views) for views in ("train", "heldout") if first.view_indices(views)]
    every = [(curves, row) for _, members in rows for curves, row in members]
    if any(ERROR_3D in curves.values.get(row, {}) for curves, row in every):
        panels.insert(0, (ERROR_3D, "points"))
    figure, places = made_figure(1, len(panels), (4.4 * len(panels), 3.4), title)
    for axes, panel in zip(places, panels, strict=True):
        _error_panel(axes, rows, panel, sequence)
        axes.set(xlim=(0, max(first.facts.frames) - 1))
        axes.axvspan(-0.5, first.facts.first_unseen - 0.5, color=SEEN_SHADE, zorder=0, label="seen in training")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), fontsize=7)
    return figure


def _error_panel(axes: Axes, rows: Rows, panel: tuple[str, str], sequence: str | None) -> None:
    metric, views = panel
    methods, references = cycle(METHOD_COLORS), cycle(_REFERENCE_COLORS)
    for label, members in rows:
        is_method = any(row in curves.facts.methods for curves, row in members)
        color = next(methods if is_method else references)
        known = [(curves, row) for curves, row in members if metric in curves.values.get(row, {})]
        if not known:
            continue
        lines = [_lines(curves, row, panel, sequence) for curves, row in known]
        length = max(line.shape[1] for line in lines)
        padded = [np.pad(n, ((0, 0), (0, length - n.shape[1])), constant_values=np.nan) for n in lines]
        stacked = np.concatenate(padded) * (1.0 if metric == ERROR_3D else 1e3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # frames beyond all sequences
            mean, std = np.nanmean(stacked, 0), np.nanstd(stacked, 0)
        style = "-" if is_method else "--" if label == members[0][0].facts.reference else ":"
        axes.plot(mean, style, color=color, label=label, linewidth=1.8 if is_method else 1.2)
        if is_method and len(stacked) > 1:
            axes.fill_between(np.arange(length), mean - std, mean + std, color=color, alpha=0.15, linewidth=0)
    titles = {"points": "3D error [% of diagonal]", "train": "l2 ×10⁻³, training views",
              "heldout": "l2 ×10⁻³, views never trained on"}  # fmt: skip
    axes.set_title(titles[views], fontsize=9)
    axes.set(xlabel="frame", ylim=(0, None))


def _lines(curves: ObjectCurves, row: str, panel: tuple[str, str], sequence: str | None) -> np.ndarray:
    """(S, F) values, averaged over the panel's views."""
    metric, views = panel
    values = curves.values[row][metric]
    if views != "points":
        values = values[:, :, curves.view_indices(views)].mean(-1)
    return values if sequence is None else values[[curves.facts.sequences.index(sequence)]]


def slices_plot(
    columns: Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]], first_unseen: int
) -> tuple[Figure, list[tuple[str, int]]]:
    """Space-time slices below each other, and the line ("column" | "row", index) of every column.

    It is the line with the most motion in the column's first film. A column is a heading and films, each a label
    and (F, H, W, 3) uint8 of any length; a line marks ``first_unseen``.
    """
    rows, wide = len(columns[0][1]), len(columns) > 1
    size = (5.2 * len(columns) if wide else 7.0, 1.5 * rows + 0.6 if wide else 2.6 * rows)
    figure, places = made_figure(rows, len(columns), size)
    grid = places.reshape(rows, len(columns))
    lines = [moving_line(films[0][1]) for _, films in columns]
    for column, (panels, (title, films), line) in enumerate(zip(grid.T, columns, lines, strict=True)):
        for axes, (label, frames) in zip(panels, films, strict=True):
            axes.imshow(space_time_slice(frames, line), aspect="auto", interpolation="nearest")
            if first_unseen < len(frames):
                axes.axvline(first_unseen - 0.5, color="#f0962a", linewidth=1.4)
            axes.set(yticks=[], xlim=(-0.5, len(films[-1][1]) - 0.5))
            axes.tick_params(labelsize=7, labelbottom=axes is panels[-1])
            if column == 0:
                axes.set_ylabel(label, fontsize=8)
        panels[0].set_title(f"{title}: {line[0]} {line[1]} over time", fontsize=9)
        panels[-1].set_xlabel("frame (unseen right of the line)", fontsize=8)
    return figure, lines


def slice_figure(
    truth: np.ndarray | None, prediction: np.ndarray, path: Path, *, title: str, first_unseen: int
) -> tuple[str, int]:
    """Writes space-time slices of truth (if given) above prediction; returns their line.

    Films are (F, H, W, 3) uint8, of any length; a line marks ``first_unseen``.
    """
    films = [] if truth is None else [("ground truth", truth)]
    figure, lines = slices_plot([(title, [*films, ("prediction", prediction)])], first_unseen)
    save_figure(figure, path)
    return lines[0]


def panels_plot(
    rows: Sequence[tuple[str, Sequence[np.ndarray | None]]], heads: Sequence[tuple[str, bool]], *, title: str = ""
) -> Figure:
    """Labelled rows of (H, W, 3) uint8 pictures (None: empty); headings of unseen columns are orange."""
    height, width = next(image.shape[:2] for _, images in rows for image in images if image is not None)
    size = (1.25 * len(heads), 1.25 * height / width * len(rows) + (0.6 if title else 0.3))
    figure, places = made_figure(len(rows), len(heads), size, title)
    grid = places.reshape(len(rows), len(heads))
    for panels, (label, images) in zip(grid, rows, strict=True):
        for axes, image in zip(panels, images, strict=True):
            axes.set(xticks=[], yticks=[])
            if image is not None:
                axes.imshow(image)
        panels[0].set_ylabel(label, fontsize=8)
    for axes, (head, unseen) in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=7, color="#c2410c" if unseen else "black")
    return figure


def contact_sheet(
    truth: np.ndarray | None, prediction: np.ndarray, path: Path, *, title: str, first_unseen: int
) -> None:
    """Frames of truth, prediction and error below each other; unseen frames have orange numbers.

    They are the first, the last seen, the first unseen, the last, and evenly spaced ones between. Films are
    (F, H, W, 3) uint8; frames beyond the truth are empty.
    """
    last = len(prediction) - 1
    edges = {0, min(first_unseen - 1, last), min(first_unseen, last), last}
    even = np.linspace(0, last, 8).round().astype(int).tolist()
    chosen = sorted(edges | {f for f in even if min(abs(f - e) for e in edges) > 2})
    rows: list[tuple[str, list[np.ndarray | None]]] = [("prediction", [prediction[f] for f in chosen])]
    if truth is not None:
        true = [truth[f] if f < len(truth) else None for f in chosen]
        errors = [error_colors(truth[f], prediction[f]) if f < len(truth) else None for f in chosen]
        rows = [("ground truth", true), *rows, ("error", errors)]
    save_figure(panels_plot(rows, [(str(f), f >= first_unseen) for f in chosen], title=title), path)


def picture_grid(images: Sequence[np.ndarray], labels: Sequence[str], path: Path, *, title: str, columns: int) -> None:
    """Labelled (H, W, 3) uint8 pictures in rows of ``columns``, as PNG."""
    ratio, rows = images[0].shape[0] / images[0].shape[1], -(-len(images) // columns)
    figure, places = made_figure(rows, columns, (3.2 * columns, (3.2 * ratio + 0.3) * rows + 0.3), title)
    for axes in places:
        axes.set_axis_off()
    for axes, image, label in zip(places, images, labels, strict=False):  # the last row may be incomplete
        axes.imshow(image)
        axes.set_title(label, fontsize=8)
    save_figure(figure, path)


def diagnosis_plot(named: Sequence[tuple[str, DiagnosisFigures, str]], *, title: str) -> Figure:
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


def diagnosis_figure(name: str, info: ObjectInfo, path: Path) -> bool:
    """Writes the figure of one evaluation; returns False if it has no diagnosis."""
    found = read_diagnosis(info.diagnosis, info.splits["seen"][1])
    methods = [m for m in info.methods if found is not None and m in found.rows]
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


def made_figure(rows: int, columns: int, size: tuple[float, float], title: str = "") -> tuple[Figure, np.ndarray]:
    """A figure of ``size`` [inches] with its axes, row by row."""
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=10)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def literal(figure: Figure) -> Figure:
    """The figure with its texts as they stand: a dollar sign in a name would start a formula."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure atomically, and creates its folder."""
    with replacing(path, typed=True) as temporary:
        figure.savefig(temporary)
