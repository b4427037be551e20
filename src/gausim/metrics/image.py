"""Image metrics: one value per image, averaged over images and ranks."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from gausim.ops.similarity import gaussian_taps, image_loss

# Limits the PSNR of identical images to 100 dB, which otherwise would be infinite.
SMALLEST_MSE = 1e-10
# Window of SSIM, with a Gaussian of sigma 1.5 as in the original definition and papers on 3DGS. The training loss uses
# window 5: a metric for the comparison of methods should not be the loss of one of them.
WINDOW = 11
Images = Float[Tensor, "B H W 3"]
Mask = Bool[Tensor, "B H W"]
PerImage = Float[Tensor, " B"]


class ImageMetric(Metric, ABC):
    """Mean of :meth:`per_image` over images; sums are reduced over ranks, so every rank computes the same mean."""

    key: ClassVar[str]  # name in result files
    label: ClassVar[str]  # name in tables and figures
    scale: ClassVar[float] = 1.0  # factor on the value in tables
    unit: ClassVar[str] = ""  # of the scaled value
    foreground: ClassVar[bool] = False  # whether only the foreground of the true image counts
    higher_is_better = False
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """The metric of every image in [0, 1]; NaN for a foreground metric of an image without foreground.

        ``mask`` is the foreground of the true images (unused by whole-image metrics).
        """

    def update(self, prediction: Images, target: Images, mask: Mask) -> None:
        """Adds a batch of images, leaving out those without a value (no foreground)."""
        values = self.per_image(prediction, target, mask)
        known = values[~values.isnan()]
        self.total += known.detach().double().sum()
        self.count += known.shape[0]

    def compute(self) -> Float[Tensor, ""]:
        """Mean over all images so far."""
        return self.total / self.count


def masked_mean(values: Float[Tensor, "B H W"], mask: Mask) -> PerImage:
    """Mean over the masked pixels of each image; NaN for an image without any."""
    weight = mask.to(values)
    return (values * weight).sum((1, 2)) / weight.sum((1, 2))


def mask_iou(prediction: Float[Tensor, "*B H W"], target: Float[Tensor, "*B H W"]) -> Float[Tensor, " *B"]:
    """Intersection over union of the pixels with alpha above 1/2, per image; NaN where neither image has any."""
    ours, true = prediction > 0.5, target > 0.5
    both, either = (ours & true).sum((-2, -1)), (ours | true).sum((-2, -1))
    return both / torch.where(either > 0, either, torch.nan)


class L2(ImageMetric):
    """Mean over all pixels of the per-pixel 2-norm over RGB, colours in [0, 1] (the l2 of the GausSim paper)."""

    key, label, scale, unit = "l2", "l2", 1e3, "1e-3"

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """Mean over the image, or its foreground."""
        distance = (prediction - target).norm(dim=-1)
        return masked_mean(distance, mask) if self.foreground else distance.mean((1, 2))


class ForegroundL2(L2):
    """The same over the foreground pixels of the true image only, without the black background."""

    key, label, foreground = "l2_foreground", "l2 foreground", True


class PSNR(ImageMetric):
    """-10 log10 of the mean squared error over pixels and channels [dB], peak 1, at most 100; mean over images."""

    key, label, unit, higher_is_better = "psnr", "PSNR", "dB", True

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """PSNR of the image, or its foreground."""
        squared = (prediction - target).square()
        mean = masked_mean(squared.mean(-1), mask) if self.foreground else squared.mean((1, 2, 3))
        return -10 * torch.log10(mean.clamp_min(SMALLEST_MSE))


class ForegroundPSNR(PSNR):
    """The same over the foreground pixels of the true image only."""

    key, label, foreground = "psnr_foreground", "PSNR foreground", True


class SSIM(ImageMetric):
    """Mean SSIM (Wang et al. 2004) over pixels and channels; images must be larger than half the window."""

    key, label, scale, unit, higher_is_better = "ssim", "SSIM", 10.0, "1e-1", True

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """SSIM of the whole image."""
        scale = 2 / prediction[0].numel()
        return 1 - image_loss(prediction[:, None], target[:, None], gaussian_taps(WINDOW), balance=0.0, scale=scale)[0]
