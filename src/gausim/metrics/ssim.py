"""Structural similarity (Wang et al. 2004), kornia's implementation."""

from __future__ import annotations

import kornia.metrics
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.metrics.image import ImageMetric


class SSIM(ImageMetric):
    """Mean SSIM over pixels and channels of the whole image.

    Window 11 with a Gaussian of sigma 1.5, as in the original definition and in what 3DGS work reports. The training
    loss uses window 5: a figure that is compared between methods must not be the one that one of them optimises.

    Args:
        window_size: odd size of the Gaussian window [pixels]; images must be larger than half of it.
    """

    key = "ssim"
    label = "SSIM"
    scale = 10.0
    unit = "1e-1"
    higher_is_better = True

    def __init__(self, window_size: int = 11) -> None:
        super().__init__()
        self.window_size = window_size

    def per_image(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> Float[Tensor, " B"]:
        """SSIM of the whole image."""
        first, second = (images.permute(0, 3, 1, 2) for images in (prediction, target))
        return kornia.metrics.ssim(first, second, self.window_size).mean((1, 2, 3))
