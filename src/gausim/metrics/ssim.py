"""Structural similarity (Wang et al. 2004), kornia's implementation."""

from __future__ import annotations

import kornia.metrics

from gausim.metrics.image import ImageMetric, Images, Mask, PerImage

# Window 11 with a Gaussian of sigma 1.5, as in the original definition and in papers on 3DGS. The training loss uses
# window 5: a metric for the comparison of methods should not be the loss of one of them.
WINDOW = 11


class SSIM(ImageMetric):
    """Mean SSIM over pixels and channels of the whole image; images must be larger than half the window."""

    key = "ssim"
    label = "SSIM"
    scale = 10.0
    unit = "1e-1"
    higher_is_better = True

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """SSIM of the whole image."""
        first, second = (images.permute(0, 3, 1, 2) for images in (prediction, target))
        return kornia.metrics.ssim(first, second, WINDOW).mean((1, 2, 3))
