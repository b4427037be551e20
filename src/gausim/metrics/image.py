"""Base class of image metrics: one value per image, averaged over images and ranks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

Images = Float[Tensor, "B H W 3"]
Mask = Bool[Tensor, "B H W"]
PerImage = Float[Tensor, " B"]


class ImageMetric(Metric, ABC):
    """Mean of :meth:`per_image` over images; sums are reduced over ranks, so every rank computes the same mean.

    Attributes:
        key: name in result files.
        label: name in tables and figures.
        scale: factor on the value in tables.
        unit: unit of the scaled value.
        higher_is_better: whether larger values are better.
    """

    key: ClassVar[str]
    label: ClassVar[str]
    scale: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""
    higher_is_better = False
    is_differentiable = True
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
