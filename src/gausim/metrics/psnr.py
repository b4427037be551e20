"""Peak signal-to-noise ratio per image, over all pixels or the foreground."""

from __future__ import annotations

from torch import log10

from gausim.metrics.image import ImageMetric, Images, Mask, PerImage, masked_mean

# Limits the PSNR of identical images to 100 dB, which otherwise would be infinite.
SMALLEST_MSE = 1e-10


class PSNR(ImageMetric):
    """-10 log10 of the mean squared error over pixels and channels [dB], peak 1, at most 100; mean over images."""

    key = "psnr"
    label = "PSNR"
    unit = "dB"
    higher_is_better = True

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """PSNR of the whole image."""
        return -10 * log10((prediction - target).square().mean((1, 2, 3)).clamp_min(SMALLEST_MSE))


class ForegroundPSNR(PSNR):
    """The same over the foreground pixels of the true image only."""

    key = "psnr_foreground"
    label = "PSNR foreground"

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """PSNR of the foreground."""
        squared = (prediction - target).square().mean(-1)
        return -10 * log10(masked_mean(squared, mask).clamp_min(SMALLEST_MSE))
