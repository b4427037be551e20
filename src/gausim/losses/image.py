"""The image loss lambda L2 + (1 - lambda) D-SSIM (METHOD section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError

# Pixels of the authors' 960 x 540 frames: sums over their pixels, restated for any image size as mean times this.
REFERENCE_PIXELS = 518_400
# (k L)^2 of Wang et al. 2004 with k = 0.01, 0.03 and L = 1, and the width of their Gaussian window [pixels].
SSIM_C1, SSIM_C2, SSIM_SIGMA = 1e-4, 9e-4, 1.5

# Maps of this many images of a usual size stay in a core's cache.
IMAGES_AT_ONCE = 12


class ImageLoss(nn.Module):
    """lambda times the squared error plus (1 - lambda) times (1 - SSIM) / 2.

    Both are summed over channels, averaged over pixels and views and multiplied by ``pixels``, so that weights of
    other terms mean the same at every image size.
    """

    def __init__(
        self, *, balance: float = 0.9, window: int = 5, pixels: float = REFERENCE_PIXELS, crop: bool = True
    ) -> None:
        """Keeps the settings.

        Args:
            balance: lambda, the share of the squared error in [0, 1].
            window: odd size of the SSIM window [pixels].
            pixels: the mean over pixels is multiplied by this.
            crop: leave out the border that is black in every image. It contributes exactly zero, so only the speed
                changes; finding it waits for the device, so switch it off on a GPU.

        Raises:
            ConfigError: a setting out of range.
        """
        super().__init__()
        if not 0 <= balance <= 1 or window < 3 or window % 2 == 0 or pixels <= 0:
            raise ConfigError(
                f"loss.image: expected balance in [0, 1], an odd window >= 3 and pixels > 0, got balance {balance}, "
                f"window {window}, pixels {pixels}."
            )
        self.balance, self.window, self.pixels, self.crop = balance, window, float(pixels), crop

    def forward(
        self, prediction: Float[Tensor, "B V H W 3"], target: Float[Tensor, "B V H W 3"]
    ) -> Float[Tensor, " B"]:
        """Loss of each of B states, averaged over its V views."""
        count = prediction[0, ..., 0].numel()
        if self.crop:
            rows, columns = _not_black(prediction.detach(), target, margin=2 * (self.window // 2), least=self.window)
            prediction, target = (x[:, :, rows, columns] for x in (prediction, target))
        loss: Tensor = _StateByState.apply(prediction, target, self)
        return loss * (self.pixels / count)

    def _of_states(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Sums over views, pixels and channels of each state."""
        total = self.balance * (prediction - target).square().sum((1, 2, 3, 4))
        if self.balance < 1:
            first, second = (x.movedim(-1, 2).flatten(0, 2) for x in (prediction, target))
            loss = (1 - structural_similarity(first, second, self.window)) / 2
            total = total + (1 - self.balance) * loss.reshape(total.shape[0], -1).sum(1)
        return total


class _StateByState(torch.autograd.Function):
    """The losses of the states and their gradients, a few images at a time.

    The intermediate maps of SSIM for a whole rollout fill hundreds of megabytes; a few images stay in the cache, which
    is two to three times as fast on a CPU. The gradient is formed with the loss and scaled in the backward pass.
    """

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, loss: ImageLoss) -> Tensor:
        states = max(1, IMAGES_AT_ONCE // prediction.shape[1])
        wanted = ctx.needs_input_grad[0]
        gradient = torch.empty_like(prediction) if wanted else None
        values = []
        for start in range(0, prediction.shape[0], states):
            part = prediction[start : start + states].detach().clone().requires_grad_(wanted)
            with torch.set_grad_enabled(wanted):
                value = loss._of_states(part, target[start : start + states])
                total = value.sum()
            if gradient is not None:
                (gradient[start : start + states],) = torch.autograd.grad(total, part)
            values.append(value.detach())
        ctx.save_for_backward(gradient)
        return torch.cat(values)

    @staticmethod
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Tensor | None, None, None]:
        (gradient,) = ctx.saved_tensors
        return None if gradient is None else gradient * incoming[0][:, None, None, None, None], None, None


def structural_similarity(
    first: Float[Tensor, "N H W"], second: Float[Tensor, "N H W"], window: int
) -> Float[Tensor, "N H W"]:
    """SSIM map with a Gaussian window and reflected borders, as kornia computes it, at half of its cost on a CPU.

    Differentiable in ``first`` only: ``second`` is the ground truth.
    """
    offsets = torch.arange(window) - window // 2
    weights = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2))
    taps = (weights / weights.sum()).tolist()
    with torch.no_grad():
        mean_second = _blur(second, taps)
        variance_second = _blur(second * second, taps) - mean_second.square()
    mean_first = _blur(first, taps)
    square_first = mean_first.square()
    variance_first = _blur(first * first, taps) - square_first
    means = mean_first * mean_second
    covariance = _blur(first * second.detach(), taps) - means
    above = (2 * means + SSIM_C1) * (2 * covariance + SSIM_C2)
    below = (square_first + mean_second.square() + SSIM_C1) * (variance_first + variance_second + SSIM_C2)
    return above / below


def _blur(image: Tensor, taps: Sequence[float]) -> Tensor:
    half = len(taps) // 2
    height, width = image.shape[-2:]
    padded = F.pad(image[:, None], (half, half, half, half), mode="reflect")[:, 0]
    # Shifted sums beat a depth-wise convolution on the CPU; symmetric taps need one product per pair.
    rows = taps[half] * padded[:, half : half + height]
    for i in range(half):
        rows = rows + taps[i] * (padded[:, i : i + height] + padded[:, 2 * half - i : 2 * half - i + height])
    result = taps[half] * rows[..., half : half + width]
    for i in range(half):
        result = result + taps[i] * (rows[..., i : i + width] + rows[..., 2 * half - i : 2 * half - i + width])
    return result


def _not_black(prediction: Tensor, target: Tensor, *, margin: int, least: int) -> tuple[slice, slice]:
    """Rows and columns outside which both are black, widened so that no SSIM window of a coloured pixel is cut."""
    coloured = ((prediction != 0) | (target != 0)).flatten(0, 1).any(-1).any(0)
    return _span(coloured.any(1), margin, least), _span(coloured.any(0), margin, least)


def _span(used: Tensor, margin: int, least: int) -> slice:
    length, where = used.shape[0], used.nonzero()
    if len(where) == 0:
        return slice(0, min(length, least))
    low, high = max(0, int(where[0]) - margin), min(length, int(where[-1]) + 1 + margin)
    if high - low < least:  # reflection needs more pixels than half a window
        low = max(0, min(low, length - least))
        high = min(length, low + least)
    return slice(low, high)
