"""Pictures of the kernels: units of every level of a hierarchy, and the colours of a scale."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib import colormaps
from matplotlib.colors import hsv_to_rgb
from torch import Tensor

from gausim.pictures.figures import made_figure, save_figure

# Distance of successive units' hues on the colour circle: multiples of the golden ratio never repeat.
GOLDEN = 0.6180339887498949
# Area of a point for a thousand kernels, smaller for more [points^2].
POINT_AREA = 30.0
PINNED_COLOR = (0.25, 0.25, 0.25)


def draw_clusters(
    path: Path,
    means: Float[np.ndarray, "K 3"],
    labels: Sequence[Int[np.ndarray, " K"]],
    pinned: Bool[np.ndarray, " K"],
    *,
    title: str,
    names: Sequence[str],
    sides: tuple[tuple[int, int], tuple[int, int]],
    flip: bool = False,
) -> None:
    """Writes a picture of kernels at ``means`` [scene units], one column per level and one row per side.

    ``labels`` has the unit of every kernel at each level; pinned kernels are dark grey. ``sides`` are the
    horizontal and the vertical axis of each row (0, 1, 2 for x, y, z); ``flip`` draws the vertical one downwards.
    """
    figure, places = made_figure(2, len(labels), (4.2 * len(labels), 8.4), title)
    panels = places.reshape(2, len(labels))
    area = min(POINT_AREA, max(0.3, POINT_AREA * 1e3 / len(means)))
    for column, (unit, name) in enumerate(zip(labels, names, strict=True)):
        colors = unit_colors(unit)
        colors[pinned] = PINNED_COLOR
        for row, (across, up) in enumerate(sides):
            panel = panels[row, column]
            # In the order of depth (the third axis), the nearest last.
            order = np.argsort(means[:, 3 - across - up] * (1 if row else -1), kind="stable")
            panel.scatter(means[order, across], means[order, up], s=area, c=colors[order], linewidths=0)
            panel.set_aspect("equal")
            panel.set_xlabel("xyz"[across])
            panel.set_ylabel("xyz"[up])
            if flip:
                panel.invert_yaxis()
            if row == 0:
                panel.set_title(name)
    save_figure(figure, path)


def unit_colors(unit: Int[np.ndarray, " K"]) -> Float[np.ndarray, "K 3"]:
    """One RGB colour per unit: hues by the golden ratio, three brightnesses."""
    hue = (unit * GOLDEN) % 1.0
    return hsv_to_rgb(np.stack((hue, np.full(len(unit), 0.75), np.array([1.0, 0.8, 0.6])[unit % 3]), -1))


def scale_colors(fraction: Float[Tensor, " K"]) -> Float[Tensor, "K 3"]:
    """Colours of the scale (turbo) for fractions in [0, 1]."""
    return torch.from_numpy(np.asarray(colormaps["turbo"](fraction.clamp(0, 1).numpy())[:, :3], np.float32))
