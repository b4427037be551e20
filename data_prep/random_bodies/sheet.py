"""A contact sheet of a corpus: bodies at rest and where they are bent the most."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data_prep.synthetic.bodies import Array
from gausim.data.corpus import Corpus, CorpusBody
from gausim.io.files import replacing

BODIES, COLUMNS = 48, 6
CELL = (2.6, 1.5)  # of a body [inch]
AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(20.0)


def write_sheet(corpus: Corpus, path: Path) -> None:
    """Draws at most :data:`BODIES` bodies, evenly chosen, coloured by their stiffness, pinned kernels black."""
    chosen = np.unique(np.linspace(0, len(corpus) - 1, BODIES).round().astype(int))
    rows = -(-len(chosen) // COLUMNS)
    figure = Figure((COLUMNS * CELL[0], rows * CELL[1]), dpi=110)
    axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, number in zip(axes, chosen.tolist(), strict=False):
        _draw(axis, corpus.body(number))
    figure.subplots_adjust(0, 0, 1, 1 - 0.2 / (rows * CELL[1]), 0, 0.15)
    with replacing(path, typed=True) as temporary:
        figure.savefig(temporary)


def _draw(axis: Axes, body: CorpusBody) -> None:
    """A body at rest on the left, in the frame of its largest displacement on the right."""
    held = body.pinned.numpy()
    rest, moved = body.rest.double().numpy(), body.positions.double().numpy()
    length = np.linalg.norm(moved - rest, axis=-1).max(-1)
    sequence, frame = np.unravel_index(length.argmax(), length.shape)
    level = np.log10(body.stiffness.numpy() / body.stiffness.min().item())
    radius = np.linalg.norm(np.ptp(rest, axis=0)) / 2
    for side, points in ((-1, rest), (1, moved[sequence, frame])):
        across, up, near = _seen(points - (rest.max(0) + rest.min(0)) / 2).T / radius
        order = near.argsort()
        axis.scatter(
            (across + 1.1 * side)[order], up[order], s=7, c=level[order], cmap="viridis", vmin=0, vmax=1.5,
            alpha=np.interp(near[order], (-1, 1), (0.35, 1.0)), linewidths=0,
        )  # fmt: skip
        axis.scatter((across + 1.1 * side)[held], up[held], s=4, c="black", linewidths=0)
    axis.set(xlim=(-2.2, 2.2), ylim=(-1.15, 1.15), aspect="equal")
    about = body.record
    axis.set_title(f"{body.name} {about.pins} {about.simulator} T={about.period:.0f}", fontsize=6, pad=1)


def _seen(points: Array) -> Array:
    """(P, 3) coordinates to the right, up, and towards an eye that looks down a little."""
    right = [np.cos(AZIMUTH + np.pi / 2), np.sin(AZIMUTH + np.pi / 2), 0.0]
    towards = [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)]
    return points @ np.array([right, np.cross(towards, right), towards]).T
