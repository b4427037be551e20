"""Figures from result arrays: errors over time, space-time slices, contact sheets. Never touches a model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gausim.report.pictures.frames import error_colors, moving_line, space_time_slice
from gausim.results.curves import ERROR_3D, STATIC, ObjectCurves

_DPI = 110
SEEN_SHADE = "#dde6ee"
METHOD_COLORS = ("#c2410c", "#1d4ed8", "#15803d", "#7e22ce", "#0e7490", "#a16207", "#be185d", "#4d7c0f")
_REFERENCE_COLORS = ("#555555", "#999999", "#bbbbbb")


def error_figure(curves: ObjectCurves, path: Path, *, sequence: str | None = None) -> None:
    """Errors over time of every row: 3D where truth exists, then l2 in the training and held-out views.

    Args:
        curves: the evaluated object.
        path: PNG to write.
        sequence: one sequence; mean over all, with a band of one standard deviation for the methods, when None.
    """
    facts = curves.facts
    title = f"{facts.name}, {sequence or f'mean over {len(facts.sequences)} sequences'}"
    save_figure(error_plot([(row, [(curves, row)]) for row in curves.rows], title=title, sequence=sequence), path)


def error_plot(
    rows: Sequence[tuple[str, Sequence[tuple[ObjectCurves, str]]]], *, title: str = "", sequence: str | None = None
) -> Figure:
    """The same of rows that may come from several evaluations.

    Args:
        rows: label, and the evaluations (seeds) with the name of their row; mean and band are over all of them.
        title: heading.
        sequence: one sequence; all when None.
    """
    first = rows[0][1][0][0]
    panels = [("l2", views) for views in ("train", "heldout") if first.view_indices(views)]
    every = [(curves, row) for _, members in rows for curves, row in members]
    if any(ERROR_3D in curves.values.get(row, {}) for curves, row in every):
        panels.insert(0, (ERROR_3D, "points"))
    figure = Figure(figsize=(4.4 * len(panels), 3.4), dpi=_DPI, layout="constrained")
    for axes, panel in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
        _error_panel(axes, rows, panel, sequence)
        axes.set(xlim=(0, max(first.facts.frames) - 1))
        axes.axvspan(-0.5, first.facts.first_unseen - 0.5, color=SEEN_SHADE, zorder=0, label="seen in training")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), fontsize=7)
    figure.suptitle(title, fontsize=10)
    return figure


def _error_panel(
    axes: Axes,
    rows: Sequence[tuple[str, Sequence[tuple[ObjectCurves, str]]]],
    panel: tuple[str, str],
    sequence: str | None,
) -> None:
    metric, views = panel
    methods, references = cycle(METHOD_COLORS), cycle(_REFERENCE_COLORS)
    for label, members in rows:
        is_method = any(row in curves.facts.methods for curves, row in members)
        color = next(methods if is_method else references)
        lines = [
            _lines(curves, row, panel, sequence) for curves, row in members if metric in curves.values.get(row, {})
        ]
        if not lines:
            continue
        length = max(line.shape[1] for line in lines)
        padded = [np.pad(n, ((0, 0), (0, length - n.shape[1])), constant_values=np.nan) for n in lines]
        stacked = np.concatenate(padded) * (1.0 if metric == ERROR_3D else 1e3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # frames that no sequence has
            mean, std = np.nanmean(stacked, 0), np.nanstd(stacked, 0)
        style = "-" if is_method else "--" if label == STATIC else ":"
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


def slice_figure(
    truth: np.ndarray | None, prediction: np.ndarray, path: Path, *, title: str, first_unseen: int
) -> tuple[str, int]:
    """Space-time slices of truth above prediction, through the line that moves most in the truth.

    Args:
        truth: (F, H, W, 3) uint8, of any length; without it the prediction chooses the line.
        prediction: (F, H, W, 3) uint8.
        path: PNG to write.
        title: sequence and view.
        first_unseen: first frame that training did not see; a line marks it.

    Returns:
        The line: ("column" | "row", index).
    """
    line = moving_line(prediction if truth is None else truth)
    images = {"prediction": prediction} if truth is None else {"ground truth": truth, "prediction": prediction}
    figure = Figure(figsize=(7.0, 2.6 * len(images)), dpi=_DPI, layout="constrained")
    for axes, (name, frames) in zip(np.ravel(figure.subplots(len(images), 1)), images.items(), strict=True):
        axes.imshow(space_time_slice(frames, line), aspect="auto", interpolation="nearest")
        if first_unseen < len(frames):
            axes.axvline(first_unseen - 0.5, color="#f0962a", linewidth=1.4)
        axes.set(ylabel=name, xlim=(-0.5, len(prediction) - 0.5), yticks=[])
    axes.set_xlabel("frame (foreseen right of the line)")
    figure.suptitle(f"{title}: {line[0]} {line[1]} over time", fontsize=10)
    save_figure(figure, path)
    return line


def contact_frames(frames: int, first_unseen: int, count: int = 8) -> list[int]:
    """Frames worth a place on a contact sheet: first, last seen, first unseen, last, and evenly between."""
    edges = {0, min(first_unseen - 1, frames - 1), min(first_unseen, frames - 1), frames - 1}
    even = np.linspace(0, frames - 1, count).round().astype(int).tolist()
    return sorted(edges | {f for f in even if min(abs(f - e) for e in edges) > 2})


def contact_sheet(
    truth: np.ndarray | None, prediction: np.ndarray, path: Path, *, title: str, first_unseen: int
) -> None:
    """Chosen frames of truth, prediction and error under one another; foreseen frames carry an orange number.

    Args:
        truth: (F, H, W, 3) uint8, or None; frames beyond its end stay empty.
        prediction: (F, H, W, 3) uint8.
        path: PNG to write.
        title: sequence and view.
        first_unseen: first frame that training did not see.
    """
    chosen = contact_frames(len(prediction), first_unseen)
    names = ["prediction"] if truth is None else ["ground truth", "prediction", "error"]
    height = 1.25 * prediction.shape[1] / prediction.shape[2]
    figure = Figure(figsize=(1.25 * len(chosen), height * len(names) + 0.6), dpi=_DPI, layout="constrained")
    grid = figure.subplots(len(names), len(chosen), squeeze=False)
    for column, frame in enumerate(chosen):
        images: dict[str, np.ndarray] = {"prediction": prediction[frame]}
        if truth is not None and frame < len(truth):
            images |= {"ground truth": truth[frame], "error": error_colors(truth[frame], prediction[frame])}
        for axes, name in zip(grid[:, column], names, strict=True):
            axes.set(xticks=[], yticks=[])
            if name in images:
                axes.imshow(images[name])
            if column == 0:
                axes.set_ylabel(name, fontsize=8)
        foreseen = frame >= first_unseen
        grid[0, column].set_title(str(frame), fontsize=8, color="#c2410c" if foreseen else "black")
    figure.suptitle(title, fontsize=10)
    save_figure(figure, path)


def picture_grid(images: Sequence[np.ndarray], labels: Sequence[str], path: Path, *, title: str, columns: int) -> None:
    """Labelled (H, W, 3) uint8 pictures in rows of ``columns``, as PNG."""
    ratio, rows = images[0].shape[0] / images[0].shape[1], -(-len(images) // columns)
    figure = Figure(figsize=(3.2 * columns, (3.2 * ratio + 0.3) * rows + 0.3), dpi=_DPI, layout="constrained")
    places = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in places:
        axes.set_axis_off()
    for axes, image, label in zip(places, images, labels, strict=False):  # the last row may have places left
        axes.imshow(image)
        axes.set_title(label, fontsize=8)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure and the folder it lies in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
