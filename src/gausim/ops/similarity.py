"""Structural similarity of images (Wang et al. 2004), alone and in a loss with its gradient."""

import functools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from gausim.kernels.operations import SSIM_C1, SSIM_C2, operation

# Width of the Gaussian window of Wang et al. 2004 [pixels].
SSIM_SIGMA = 1.5

# Pixels per block of the torch path: they fit a CPU's cache, or keep a GPU busy.
CPU_PIXELS, GPU_PIXELS = 200_000, 4_000_000


@operation("gausim.kernels.image_loss:image_loss")
def image_loss(
    prediction: Float[Tensor, "B V H W 3"],
    target: Float[Tensor, "B V H W 3"],
    taps: tuple[float, ...],
    *,
    balance: float,
    scale: float,
) -> tuple[Float[Tensor, " B"], Float[Tensor, "B V H W 3"]]:
    """Squared errors and D-SSIM of images with their loss gradient, without reads that block the host.

    ``taps`` are the coefficients of the SSIM window along one axis, ``balance`` the weight of the squared error;
    the other part is (1 - SSIM) / 2. ``scale`` is a factor on the sums over views, pixels and channels.
    """
    pixels = prediction[0, ..., 0].numel()
    states = max(1, (CPU_PIXELS if prediction.device.type == "cpu" else GPU_PIXELS) // pixels)
    values: list[Tensor] = []
    gradients: list[Tensor] = []
    for start in range(0, prediction.shape[0], states):
        part = prediction[start : start + states].detach().clone().requires_grad_()
        true = target[start : start + states]
        with torch.enable_grad():
            value = balance * (part - true).square().sum((1, 2, 3, 4))
            if balance < 1:
                first, second = (x.movedim(-1, 2).flatten(0, 2) for x in (part, true))
                loss = (1 - structural_similarity(first, second, taps)) / 2
                value = value + (1 - balance) * loss.reshape(len(part), -1).sum(1)
            value = scale * value
            gradients += torch.autograd.grad(value.sum(), part)
        values.append(value.detach())
    return torch.cat(values), torch.cat(gradients)


@functools.cache
def gaussian_taps(window: int) -> tuple[float, ...]:
    """The Gaussian window of SSIM along one axis; sums to 1."""
    offsets = torch.arange(window) - window // 2
    weights = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2))
    return tuple((weights / weights.sum()).tolist())


def structural_similarity(
    first: Float[Tensor, "N H W"], second: Float[Tensor, "N H W"], taps: Sequence[float]
) -> Float[Tensor, "N H W"]:
    """SSIM map with a Gaussian window and reflected borders, as in kornia.

    Differentiable in ``first`` only; ``second`` is the ground truth. ``taps`` are the window along one axis.
    """
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
    # Shifted sums are faster than a depth-wise convolution on the CPU; symmetric taps need one product per pair.
    rows = taps[half] * padded[:, half : half + height]
    for i in range(half):
        rows = rows + taps[i] * (padded[:, i : i + height] + padded[:, 2 * half - i : 2 * half - i + height])
    result = taps[half] * rows[..., half : half + width]
    for i in range(half):
        result = result + taps[i] * (rows[..., i : i + width] + rows[..., 2 * half - i : 2 * half - i + width])
    return result
