"""FLIP: perceived difference of two images shown alternately (Andersson et al. 2020), by its authors' package.

The package `flip-evaluator` (extra ``flip``) computes on the CPU; images of a GPU are copied there.
"""

from __future__ import annotations

from importlib.util import find_spec

import torch

from gausim.core import ConfigError
from gausim.metrics.image import ImageMetric, Images, Mask, PerImage

NO_PACKAGE = "no package"
# Note under tables without FLIP.
NO_FLIP = "FLIP was not measured: `pip install flip-evaluator`; then evaluate again."


def flip_is_installed() -> bool:
    """Whether the package that computes FLIP is installed."""
    return find_spec("flip_evaluator") is not None


class FLIP(ImageMetric):
    """Mean FLIP error over pixels, from 0 (equal) to 1, in the paper's viewing condition (67 pixels per degree).

    Raises:
        ConfigError: the package is not installed.
    """

    key = "flip"
    label = "FLIP"
    scale = 1e2
    unit = "1e-2"
    is_differentiable = False

    def __init__(self) -> None:
        super().__init__()
        if not flip_is_installed():
            raise ConfigError(NO_FLIP)

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """Mean over the whole image."""
        from flip_evaluator import evaluate

        pairs = zip(*(images.detach().float().cpu().numpy() for images in (target, prediction)), strict=True)
        return torch.tensor([evaluate(*pair, "LDR", applyMagma=False)[1] for pair in pairs]).to(target)
