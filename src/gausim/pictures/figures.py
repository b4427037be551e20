"""Figures of results: errors over time, grids of pictures, long rollouts."""

import warnings
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from gausim.io.files import replacing
from gausim.results.curves import ERROR_3D, ObjectCurves

_DPI = 110
SEEN_SHADE = "#dde6ee"
METHOD_COLORS = ("#c2410c", "#1d4ed8", "#15803d", "#7e22ce", "#0e7490", "#a16207", "#be185d", "#4d7c0f")
_REFERENCE_COLORS = ("#555555", "#999999", "#bbbbbb")
# Labels, each with evaluations (seeds) and the name of their row.
Rows = Sequence[tuple[str, Sequence[tuple[ObjectCurves, str]]]]


def error_figure(curves: ObjectCurves, path: Path, *, sequence: str | None = None) -> None:
    """Writes the errors over time of one sequence, or their mean over all sequences."""
    title = f"{curves.name}, {sequence or f'mean over {len(curves.info.sequences)} sequences'}"
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
        axes.set(xlim=(0, max(first.info.frames) - 1))
        axes.axvspan(-0.5, first.first_unseen - 0.5, color=SEEN_SHADE, zorder=0, label="seen in training")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), fontsize=7)
    return figure


def _error_panel(axes: Axes, rows: Rows, panel: tuple[str, str], sequence: str | None) -> None:
    metric, views = panel
    methods, references = cycle(METHOD_COLORS), cycle(_REFERENCE_COLORS)
    for label, members in rows:
        is_method = any(row in curves.info.methods for curves, row in members)
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
        style = "-" if is_method else "--" if label == members[0][0].info.reference else ":"
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
    return values if sequence is None else values[[curves.info.sequences.index(sequence)]]


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
