"""Mixtures of L1, squared error and SSIM, the image losses of other methods."""

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError
from gausim.losses.image import ImageLoss
from gausim.ops.similarity import gaussian_taps, structural_similarity

# Size of the SSIM window of 3DGS and the methods after it [pixels].
SSIM_WINDOW = 11


class MixedLoss(ImageLoss):
    """``l1`` |x - y| + ``mse`` (x - y)^2 + ``dssim`` (1 - SSIM) + ``alpha`` (a - b)^2, each a mean over its values.

    Colours x, y are over black; a and b are the opacities. With ``alpha`` > 0 images have a fourth channel.
    """

    def __init__(
        self, *, l1: float = 0.0, mse: float = 0.0, dssim: float = 0.0, alpha: float = 0.0, window: int = SSIM_WINDOW
    ) -> None:
        """Stores the weights of the terms, and the odd size of the SSIM window [pixels].

        Raises:
            ConfigError: a weight is negative, or all are zero.
        """
        super().__init__(window=window)
        if min(l1, mse, dssim, alpha) < 0 or max(l1, mse, dssim, alpha) == 0:
            raise ConfigError(
                f"loss: expected l1, mse, dssim, alpha >= 0 and one of them > 0, got {l1}, {mse}, {dssim}, {alpha}."
            )
        self.l1, self.mse, self.dssim, self.alpha = l1, mse, dssim, alpha
        self.compares_alpha = alpha > 0

    def value_and_gradient(
        self, prediction: Float[Tensor, "B V H W C"], target: Float[Tensor, "B V H W C"]
    ) -> tuple[Float[Tensor, " B"], Float[Tensor, "B V H W C"]]:
        """As :meth:`ImageLoss.value_and_gradient`."""
        if self.dssim > 0:
            self.check_size(prediction)
        leaf = prediction.detach().clone().requires_grad_()
        with torch.enable_grad():
            color, true = leaf[..., :3], target[..., :3]
            difference, total = color - true, leaf.new_zeros(len(leaf))
            if self.l1 > 0:
                total = total + self.l1 * difference.abs().mean((1, 2, 3, 4))
            if self.mse > 0:
                total = total + self.mse * difference.square().mean((1, 2, 3, 4))
            if self.dssim > 0:
                first, second = (x.movedim(-1, 2).flatten(0, 2) for x in (color, true))
                similarity = structural_similarity(first, second, gaussian_taps(self.window)).reshape(len(total), -1)
                total = total + self.dssim * (1 - similarity.mean(1))
            if self.alpha > 0:
                total = total + self.alpha * (leaf[..., 3] - target[..., 3]).square().mean((1, 2, 3))
            (gradient,) = torch.autograd.grad(total.sum(), leaf)
        return total.detach(), gradient
