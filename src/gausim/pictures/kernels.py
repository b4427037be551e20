"""Pictures of the kernels: units of every level of a hierarchy, and a property in the colours of a scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, hsv_to_rgb
from torch import Tensor

from gausim.pictures.figures import made_figure, save_figure

# Distance of successive units' hues on the colour circle: multiples of the golden ratio never repeat.
GOLDEN = 0.6180339887498949
# Area of a point for a thousand kernels, smaller for more [points^2].
POINT_AREA = 30.0
PINNED_COLOR = (0.25, 0.25, 0.25)
# The scale leaves out as many kernels at each end; single extreme units would hide all differences of the others.
_LEFT_OUT = 0.01
# Least quotient of the scale's ends.
_LEAST_RANGE = 1.02
_UNKNOWN = (0.35, 0.35, 0.35)


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


def property_scale(values: Float[Tensor, " K"]) -> LogNorm:
    """A logarithmic scale for the positive values of the kernels; NaN are left out."""
    known = values[torch.isfinite(values)].double().log()
    low, high = torch.quantile(known, torch.tensor([_LEFT_OUT, 1 - _LEFT_OUT], dtype=torch.float64)).tolist()
    middle, half = (low + high) / 2, max(high - low, float(np.log(_LEAST_RANGE))) / 2
    return LogNorm(float(np.exp(middle - half)), float(np.exp(middle + half)), clip=True)


def property_colors(values: Float[Tensor, " K"], scale: LogNorm) -> Float[Tensor, "K 3"]:
    """Colours of the kernels; grey where the value is not known (NaN)."""
    known = torch.isfinite(values)
    fraction = torch.from_numpy(np.asarray(scale(torch.where(known, values, 1.0).numpy()), np.float32))
    return torch.where(known[:, None], scale_colors(fraction), torch.tensor(_UNKNOWN))


def scale_colors(fraction: Float[Tensor, " K"]) -> Float[Tensor, "K 3"]:
    """Colours of the scale (turbo) for fractions in [0, 1]."""
    return torch.from_numpy(np.asarray(colormaps["turbo"](fraction.clamp(0, 1).numpy())[:, :3], np.float32))


def draw_property(path: Path, images: Float[np.ndarray, "V H W 3"], scale: LogNorm, *, title: str, text: str) -> None:
    """Writes images of the coloured scene, in [0, 1], side by side with a colour bar labelled ``text``."""
    figure, panels = made_figure(1, len(images), (4.0 * len(images) + 1.2, 4.4), title)
    for panel, image in zip(panels, images, strict=True):
        panel.imshow(image)
        panel.set_axis_off()
    bar = figure.colorbar(ScalarMappable(scale, "turbo"), ax=list(panels), fraction=0.05)
    ticks = np.geomspace(scale.vmin or 1, scale.vmax or 1, 5)
    bar.set_ticks(ticks.tolist(), labels=[f"{tick:.3g}" for tick in ticks], minor=False)
    bar.set_ticks([], minor=True)
    bar.set_label(text)
    save_figure(figure, path)
