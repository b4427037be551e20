"""Pictures of a property of the kernels: the scene's Gaussians in the colours of a scale, seen from several sides."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from torch import Tensor

from gausim.report.pictures.figures import made_figure, save_figure

# The scale leaves out as many kernels at each end; single extreme units would hide all differences of the others.
_LEFT_OUT = 0.01
# Least quotient of the scale's ends.
_LEAST_RANGE = 1.02
_UNKNOWN = (0.35, 0.35, 0.35)


def property_scale(values: Float[Tensor, " K"]) -> LogNorm:
    """A logarithmic scale for the positive values of the kernels; NaN are left out."""
    known = values[torch.isfinite(values)].double().log()
    low, high = torch.quantile(known, torch.tensor([_LEFT_OUT, 1 - _LEFT_OUT], dtype=torch.float64)).tolist()
    middle, half = (low + high) / 2, max(high - low, float(np.log(_LEAST_RANGE))) / 2
    return LogNorm(float(np.exp(middle - half)), float(np.exp(middle + half)), clip=True)


def property_colors(values: Float[Tensor, " K"], scale: LogNorm) -> Float[Tensor, "K 3"]:
    """Colours of the kernels; grey where the value is not known (NaN)."""
    known = torch.isfinite(values)
    found = np.asarray(colormaps["turbo"](scale(torch.where(known, values, 1.0).numpy())))[:, :3]
    return torch.where(known[:, None], torch.from_numpy(found.astype(np.float32)), torch.tensor(_UNKNOWN))


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
