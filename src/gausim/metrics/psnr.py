"""Peak signal-to-noise ratio per image, over all pixels or the foreground."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.metrics.image import ImageMetric, masked_mean

# Identical images would be infinitely good and spoil every mean; 1e-10 caps them at 100 dB.
SMALLEST_MSE = 1e-10


def _decibel(mse: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    return -10 * torch.log10(mse.clamp_min(SMALLEST_MSE))


class PSNR(ImageMetric):
    """-10 log10 of the mean squared error over pixels and channels [dB], peak 1, at most 100; mean over images."""

    key = "psnr"
    label = "PSNR"
    unit = "dB"
    higher_is_better = True

    def per_image(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> Float[Tensor, " B"]:
        """PSNR of the whole image."""
        return _decibel((prediction - target).square().mean((1, 2, 3)))


class ForegroundPSNR(ImageMetric):
    """The same over the foreground pixels of the true image only."""

    key = "psnr_foreground"
    label = "PSNR foreground"
    unit = "dB"
    higher_is_better = True

    def per_image(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> Float[Tensor, " B"]:
        """PSNR of the foreground."""
        return _decibel(masked_mean((prediction - target).square().mean(-1), mask))
