"""Pictures of the examined data: views with the scene's outline, and motion over time."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gausim.doctor.clock import motion_energy
from gausim.doctor.evidence import Evidence
from gausim.pictures.figures import METHOD_COLORS, literal, made_figure, save_figure
from gausim.runs.bar import with_bar

_COLUMNS = 3
# Background behind the cut-out object, on which dark objects are visible.
_BEHIND = 90
_OUTLINE = "#f0962a"


def draw_pictures(evidence: Evidence, out: Path) -> None:
    """Writes ``views.png`` and ``motion.png`` to a folder.

    The first has frame 0 of the first sequence in every view; the orange outline is that of the rest scene, drawn by
    the camera that the file states, and must lie on the object. The second has the change from frame to frame within
    the foreground, as a fraction of each camera's largest; onset and peaks must lie above each other in all cameras.
    """
    for name, draw in with_bar((("views.png", _views), ("motion.png", _motion)), "pictures"):
        save_figure(literal(draw(evidence)), out / name)


def _views(evidence: Evidence) -> Figure:
    item = evidence.first[0]
    count, (height, width) = len(evidence.views), item.alpha.shape[-2:]
    rows = -(-count // _COLUMNS)
    figure, places = made_figure(rows, _COLUMNS, (3.4 * _COLUMNS, rows * (3.4 * height / width + 0.4)))
    for v, axes in enumerate(places):
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
    figure, panels = made_figure(count, 1, (9.0, 1.9 * count + 0.4))
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
