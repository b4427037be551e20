"""The paper's l2: mean over pixels of the Euclidean distance between RGB colours."""

from __future__ import annotations

from gausim.metrics.image import ImageMetric, Images, Mask, PerImage, masked_mean


class L2(ImageMetric):
    """Mean over all pixels of the per-pixel 2-norm over RGB, colours in [0, 1] (the l2 of the GausSim paper)."""

    key = "l2"
    label = "l2"
    scale = 1e3
    unit = "1e-3"

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """Mean over the whole image."""
        return (prediction - target).norm(dim=-1).mean((1, 2))


class ForegroundL2(L2):
    """The same over the foreground pixels of the true image only, without the black background."""

    key = "l2_foreground"
    label = "l2 foreground"

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """Mean over the foreground."""
        return masked_mean((prediction - target).norm(dim=-1), mask)
