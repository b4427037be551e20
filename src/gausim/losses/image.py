"""The image loss lambda L2 + (1 - lambda) D-SSIM (METHOD section 4)."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.ops.similarity import gaussian_taps, image_loss

# Pixels of the authors' 960 x 540 frames; their sums over pixels are the mean times this number at any image size.
REFERENCE_PIXELS = 518_400


class ImageLoss(nn.Module):
    """lambda times the squared error plus (1 - lambda) times (1 - SSIM) / 2.

    Both are summed over channels, averaged over pixels and views and multiplied by ``pixels``, so that the weights of
    other terms are independent of the image size.

    Attributes:
        compares_alpha: whether images have the opacity as their fourth channel.
    """

    compares_alpha: bool = False

    def __init__(self, *, balance: float = 0.5, window: int = 5, pixels: float = REFERENCE_PIXELS) -> None:
        """``balance`` is lambda in [0, 1], ``window`` the odd size of the SSIM window [pixels].

        Raises:
            ConfigError: a setting out of range.
        """
        super().__init__()
        if not 0 <= balance <= 1 or window < 3 or window % 2 == 0 or pixels <= 0:
            raise ConfigError(
                f"loss.image: expected balance in [0, 1], an odd window >= 3 and pixels > 0, got balance {balance}, "
                f"window {window}, pixels {pixels}."
            )
        self.balance, self.window, self.pixels = balance, window, float(pixels)

    def forward(
        self, prediction: Float[Tensor, "B V H W C"], target: Float[Tensor, "B V H W C"]
    ) -> Float[Tensor, " B"]:
        """Loss of each of B states, averaged over its V views."""
        loss: Tensor = _WithGradient.apply(prediction, target, self)
        return loss

    def value_and_gradient(
        self, prediction: Float[Tensor, "B V H W C"], target: Float[Tensor, "B V H W C"]
    ) -> tuple[Float[Tensor, " B"], Float[Tensor, "B V H W C"]]:
        """The losses and the gradient of their sum with respect to the prediction; neither is part of a graph.

        Raises:
            ConfigError: an image is smaller than the SSIM window.
        """
        self.check_size(prediction)
        scale = self.pixels / prediction[0, ..., 0].numel()
        return image_loss(prediction, target, gaussian_taps(self.window), balance=self.balance, scale=scale)

    def check_size(self, images: Float[Tensor, "B V H W C"]) -> None:
        """Raises ConfigError for images that are smaller than the SSIM window."""
        height, width = images.shape[2:4]
        if min(height, width) < self.window:
            raise ConfigError(
                f"loss: images of {width}x{height} pixels are smaller than the SSIM window of {self.window}. "
                "Draw larger images or lower the loss's `window`."
            )


class _WithGradient(torch.autograd.Function):
    """The losses as one graph node: their gradient is computed with them and scaled in the backward pass."""

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, loss: ImageLoss) -> Tensor:
        values, gradient = loss.value_and_gradient(prediction, target)
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(gradient)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * incoming[0][:, None, None, None, None], None, None
