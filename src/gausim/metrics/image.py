"""Base of the image metrics: one number per image, averaged over images and ranks."""

from __future__ import annotations

from abc import abstractmethod

from jaxtyping import Bool, Float
from torch import Tensor

from gausim.metrics.mean import PooledMean


class ImageMetric(PooledMean):
    """Mean over images of :meth:`per_image`.

    A subclass is one file that states :meth:`per_image` and how its figure is printed (see :class:`PooledMean`).
    """

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
        values = self.per_image(prediction, target, mask)
        self.add(values[~values.isnan()])


def masked_mean(values: Float[Tensor, "B H W"], mask: Bool[Tensor, "B H W"]) -> Float[Tensor, " B"]:
    """Mean over the masked pixels of each image; NaN for an image without any."""
    weight = mask.to(values)
    return (values * weight).sum((1, 2)) / weight.sum((1, 2))
