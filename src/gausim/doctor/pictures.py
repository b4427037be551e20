"""Pictures of the examined data: views with the scene's outline, motion over time, spectrum, cameras from above."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gausim.doctor.clock import motion_energy
from gausim.doctor.coverage import view_directions
from gausim.doctor.evidence import Evidence, with_bar
from gausim.doctor.motion import swing
from gausim.report.pictures.figures import METHOD_COLORS, literal, save_figure

_DPI = 110
_COLUMNS = 3
# Background behind the cut-out object, on which dark objects are visible.
_BEHIND = 90
_OUTLINE = "#f0962a"


def draw_pictures(evidence: Evidence, out: Path) -> list[tuple[str, str]]:
    """Writes all pictures to a folder; returns name and caption of each."""
    drawn: list[tuple[str, str, Callable[[Evidence], Figure]]] = [
        ("views.png", "Frame 0 of the first sequence in every view; orange: outline of the rest scene, drawn by the "
         "camera that the file states. Both must lie on each other.", _views),
        ("motion.png", "Change from frame to frame within the foreground, as a fraction of each camera's largest. "
         "Onset and peaks must lie above each other in all cameras.", _motion),
        ("spectrum.png", "Power of the change of the pictures by frequency; grey: faster than a fifth of the frame "
         "rate.", _spectrum),
        ("coverage.png", "Cameras seen from above. Orange: training views, blue: held-out ones.", _coverage),
    ]  # fmt: skip
    for name, _, figure in with_bar(drawn, "pictures"):
        save_figure(literal(figure(evidence)), out / name)
    return [(name, caption) for name, caption, _ in drawn]


def _views(evidence: Evidence) -> Figure:
    item = evidence.first[0]
    count, (height, width) = len(evidence.views), item.alpha.shape[-2:]
    rows = -(-count // _COLUMNS)
    figure = Figure(figsize=(3.4 * _COLUMNS, rows * (3.4 * height / width + 0.4)), dpi=_DPI, layout="constrained")
    for v, axes in enumerate(np.ravel(figure.subplots(rows, _COLUMNS, squeeze=False))):
        axes.set_axis_off()
        if v >= count:
            continue
        cover = item.alpha[0, v, ..., None] / 255
        axes.imshow((item.rgb[0, v] + (1 - cover) * _BEHIND).clip(0, 255).astype(np.uint8))
        title = evidence.views[v]
        if evidence.rest is not None and evidence.fits is not None:
            if evidence.rest[0].alpha[v].max() > 0.5:
                axes.contour(evidence.rest[0].alpha[v], levels=[0.5], colors=_OUTLINE, linewidths=1.2)
            fit = evidence.fits[0][v]
            title += f"   overlap {fit.overlap:.2f}, off by {fit.pixels / evidence.scale:.1f} px"
        axes.set_title(title, fontsize=8)
    return figure


def _motion(evidence: Evidence) -> Figure:
    count = len(evidence.watched)
    figure = Figure(figsize=(9.0, 1.9 * count + 0.4), dpi=_DPI, layout="constrained")
    panels = np.ravel(figure.subplots(count, 1, sharex=True, squeeze=False))
    for axes, item in zip(panels, evidence.watched, strict=True):
        energy = motion_energy(item)
        for v, view in enumerate(evidence.views):
            color = METHOD_COLORS[v % len(METHOD_COLORS)]
            axes.plot(np.arange(1, len(energy) + 1), energy[:, v] / max(energy[:, v].max(initial=0), 1e-12),
                      color=color, label=view, linewidth=1.3)  # fmt: skip
        axes.set(ylabel=item.name, ylim=(0, 1.05), yticks=[])
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=8, fontsize=7)
    panels[-1].set_xlabel("frame")
    return figure


def _spectrum(evidence: Evidence) -> Figure:
    found, fps = swing(evidence), evidence.data.fps
    figure = Figure(figsize=(9.0, 2.8), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    axes.plot(found.frequency, found.power, color=METHOD_COLORS[0])
    axes.axvspan(fps / 5, fps / 2, color="#dddddd", zorder=0)
    axes.axvline(found.dominant, color="#555555", linewidth=0.8, linestyle="--")
    axes.set(xlabel=f"frequency [Hz] at {fps:g} frames per second", ylabel="power", xlim=(0, fps / 2), ylim=(0, 1.05))
    axes.set_title(f"most power at {found.dominant:.2g} Hz", fontsize=9)
    return figure


def _coverage(evidence: Evidence) -> Figure:
    cameras = evidence.first[0].cameras
    ups = -cameras.viewmats[:, 1, :3].numpy().mean(0)
    up = int(np.abs(ups).argmax())
    first, second = (axis for axis in range(3) if axis != up)
    _, middle = view_directions(evidence)
    forward = cameras.viewmats[:, 2, :3].numpy()
    centers = cameras.centers.numpy()
    figure = Figure(figsize=(5.6, 5.6), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    if evidence.scene is not None:
        means = evidence.scene.means.numpy()
        axes.scatter(means[:, first], means[:, second], s=1, color="#999999")
    axes.plot(middle[first], middle[second], "+", color="#555555")
    for v, view in enumerate(evidence.views):
        (x, y), ahead = centers[v, [first, second]], forward[v, [first, second]]
        color = METHOD_COLORS[0 if view in evidence.data.train_views else 1]
        tip = (x, y) + 0.35 * ahead * np.hypot(x, y)
        axes.plot(x, y, "o", color=color)
        axes.annotate("", xy=tuple(tip), xytext=(x, y), arrowprops={"arrowstyle": "->", "color": color})
        axes.annotate(view, xy=(x, y), xytext=(6, 6), textcoords="offset points", fontsize=8, color=color)
    axes.set(aspect="equal", xlabel=f"{'xyz'[first]} [scene units]", ylabel=f"{'xyz'[second]} [scene units]")
    axes.set_title(f"from {'+' if ups[up] > 0 else '-'}{'xyz'[up]}", fontsize=9)
    axes.margins(0.15)
    if (ups[up] > 0) == (up == 1):  # two axes in their order are seen from the other side
        axes.invert_yaxis()
    return figure
