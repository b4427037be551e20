"""Base of the image metrics: one number per image, averaged over images and ranks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric


class ImageMetric(Metric, ABC):
    """Mean over images of :meth:`per_image`; sums are reduced over ranks, so every rank computes the same mean.

    A subclass is one file that states :meth:`per_image` and how its figure is printed:

    Attributes:
        key: name in result files.
        label: name in tables and figures.
        scale: tables print the value times this.
        unit: what the printed number is in.
        higher_is_better: which way is good.
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
    def per_image(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> Float[Tensor, " B"]:
        """The metric of every image.

        Args:
            prediction: predicted images in [0, 1].
            target: true images in [0, 1].
            mask: foreground pixels of the true images (whole-image metrics do not look at it).

        Returns:
            One value per image; NaN where a foreground metric finds no foreground.
        """

    def update(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> None:
        """Adds a batch of images; images without a value (no foreground) do not count."""
        values = self.per_image(prediction, target, mask).detach().double()
        defined = ~values.isnan()
        self.total += values[defined].sum()
        self.count += defined.sum()

    def compute(self) -> Float[Tensor, ""]:
        """Mean over all images seen so far."""
        return self.total / self.count


def masked_mean(values: Float[Tensor, "B H W"], mask: Bool[Tensor, "B H W"]) -> Float[Tensor, " B"]:
    """Mean over the masked pixels of each image; NaN for an image without any."""
    weight = mask.to(values)
    return (values * weight).sum((1, 2)) / weight.sum((1, 2))
