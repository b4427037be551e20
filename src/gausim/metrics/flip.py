"""FLIP: how different two images look when one flips between them (Andersson et al. 2020), LDR, no learned weights."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.core import ConfigError
from gausim.metrics.image import ImageMetric

# A monitor 0.7 m wide with 3840 pixels, seen from 0.7 m: the paper's viewing condition [pixels per degree].
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
# Contrast sensitivity of the achromatic, red-green and blue-yellow channels: Gaussians (a, b) in degrees (table 1).
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_WIDEST = 0.04
# Exponent of colour errors, where their upper range begins, what it is mapped to, exponent and width of features.
_QC, _PC, _PT, _QF, _FEATURE_WIDTH = 0.7, 0.4, 0.95, 0.5, 0.082
# Linear sRGB to CIE XYZ (rows X, Y, Z), with D65 as white; in whole numbers, so that grey has no chroma at all.
_TO_XYZ = torch.tensor(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    dtype=torch.float64,
)


class FLIP(ImageMetric):
    """Mean FLIP error over pixels, 0 (alike) to 1; pixels and colours are weighed as an observer sees them.

    Args:
        pixels_per_degree: of visual angle; the default is the paper's viewing condition.

    Raises:
        ConfigError: ``pixels_per_degree`` is not positive.
    """

    key = "flip"
    label = "FLIP"
    scale = 1e2
    unit = "1e-2"

    def __init__(self, pixels_per_degree: float = PIXELS_PER_DEGREE) -> None:
        super().__init__()
        if not pixels_per_degree > 0:
            raise ConfigError(f"FLIP: pixels_per_degree is {pixels_per_degree}; expected a positive number.")
        self.pixels_per_degree = pixels_per_degree

    def per_image(
        self,
        prediction: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        mask: Bool[Tensor, "B H W"],
    ) -> Float[Tensor, " B"]:
        """Mean over the whole image."""
        return flip_map(prediction, target, self.pixels_per_degree).mean((1, 2))


def flip_map(
    prediction: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float[Tensor, "B H W"]:
    """FLIP error of every pixel of sRGB images in [0, 1]: colour error to the power of 1 - feature error (eq. 11)."""
    opponent = _opponent(torch.cat((prediction, target)).permute(0, 3, 1, 2).clamp(0, 1))
    first, second = _perceived(opponent, pixels_per_degree).chunk(2)
    color = _colour_error(_distance(first, second), opponent)
    features = _features((opponent[:, :1] + 16) / 116, pixels_per_degree)
    strength = [(a - b).abs() for a, b in (f.chunk(2) for f in features)]
    feature = (torch.maximum(*strength) / math.sqrt(2)) ** _QF
    return color ** (1 - feature)


def _linear(srgb: Tensor) -> Tensor:
    return torch.where(srgb > 0.04045, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def _xyz(linear: Tensor, *, inverse: bool = False) -> Tensor:
    """Linear RGB (B, 3, H, W) to XYZ relative to white, or back."""
    relative = _TO_XYZ / _TO_XYZ.sum(1, keepdim=True)
    matrix = torch.linalg.inv(relative) if inverse else relative
    return torch.einsum("ij,bjhw->bihw", matrix.to(linear), linear)


def _opponent(srgb: Tensor) -> Tensor:
    """YCxCz: a linear version of CIELAB."""
    x, y, z = _xyz(_linear(srgb)).unbind(1)
    return torch.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), 1)


def _perceived(opponent: Tensor, pixels_per_degree: float) -> Tensor:
    """What an observer perceives: blurred by the eye, in CIELAB, chroma less the darker it is (Hunt)."""
    radius = math.ceil(3 * math.sqrt(_WIDEST / (2 * math.pi**2)) * pixels_per_degree)
    channels = []
    for channel, gaussians in enumerate(_SENSITIVITY):
        kernels = [_sensitivity(b, radius, pixels_per_degree) for _, b in gaussians]
        # A two-dimensional kernel's weight is the square of its one-dimensional sum.
        weights = [
            a * math.sqrt(math.pi / b) * float(k.sum()) ** 2 for (a, b), k in zip(gaussians, kernels, strict=True)
        ]
        image = opponent[:, channel : channel + 1]
        blurred = [w * _separable(image, k / k.sum(), k / k.sum()) for w, k in zip(weights, kernels, strict=True)]
        channels.append(torch.stack(blurred).sum(0) / sum(weights))
    lightness, cx, cz = torch.cat(channels, 1).unbind(1)
    y = (lightness + 16) / 116
    linear = _xyz(torch.stack((y + cx / 500, y, y - cz / 200), 1), inverse=True).clamp(0, 1)
    return _hunt_lab(linear)


def _hunt_lab(linear: Tensor) -> Tensor:
    ratio = _xyz(linear)
    bend = (6 / 29) ** 3
    root = torch.where(ratio > bend, ratio.clamp_min(bend) ** (1 / 3), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    x, y, z = root.unbind(1)
    lightness = 116 * y - 16
    return torch.stack((lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)), 1)


def _distance(first: Tensor, second: Tensor) -> Tensor:
    """HyAB: city-block between lightness and chroma, Euclidean within chroma."""
    difference = first - second
    return difference[:, 0].abs() + torch.hypot(difference[:, 1], difference[:, 2])


def _colour_error(distance: Tensor, like: Tensor) -> Tensor:
    """Distances to [0, 1]: most of the range for those that are common, the rest for extreme ones."""
    extremes = torch.eye(3, dtype=torch.float64)[1:, :, None, None]
    green, blue = _hunt_lab(extremes).chunk(2)
    largest = float(_distance(green, blue)) ** _QC
    error, knee = distance**_QC, _PC * largest
    upper = _PT + (error - knee) / (largest - knee) * (1 - _PT)
    return torch.where(error < knee, _PT / knee * error, upper).to(like)


def _features(lightness: Tensor, pixels_per_degree: float) -> tuple[Tensor, Tensor]:
    """Strength of edges and of points at every pixel, (B, H, W) each."""
    smooth, edge, point = _feature_kernels(pixels_per_degree)
    found = []
    for kernel in (edge, point):
        across, down = _separable(lightness, kernel, smooth), _separable(lightness, smooth, kernel)
        found.append(torch.hypot(across, down)[:, 0])
    return found[0], found[1]


@lru_cache(maxsize=8)
def _sensitivity(b: float, radius: int, pixels_per_degree: float) -> Tensor:
    x = torch.arange(-radius, radius + 1, dtype=torch.float64) / pixels_per_degree
    return torch.exp(-(math.pi**2) * x**2 / b)


@lru_cache(maxsize=8)
def _feature_kernels(pixels_per_degree: float) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussian, its first and second derivative; of these, positive weights sum to 1 and negative ones to -1."""
    deviation = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = math.ceil(3 * deviation)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)
    smooth = torch.exp(-(x**2) / (2 * deviation**2))
    kernels = [-x * smooth, (x**2 / deviation**2 - 1) * smooth]
    balanced = [torch.where(k < 0, k / -k[k < 0].sum(), k / k[k > 0].sum()) for k in kernels]
    return smooth / smooth.sum(), balanced[0], balanced[1]


def _separable(image: Float[Tensor, "B 1 H W"], across: Tensor, down: Tensor) -> Float[Tensor, "B 1 H W"]:
    """Correlation with a product of two kernels; borders are repeated outwards.

    As products with banded matrices, which is three times faster on CPUs than convolutions of a single channel.
    """
    height, width = image.shape[-2:]
    return _band(down, height).to(image) @ image @ _band(across, width).to(image).mT


def _band(kernel: Tensor, size: int) -> Float[Tensor, "n n"]:
    """Matrix whose product with a line of ``size`` pixels is the line's correlation with ``kernel``."""
    radius = len(kernel) // 2
    rows = torch.arange(size)[:, None].expand(-1, len(kernel))
    columns = (rows + torch.arange(-radius, radius + 1)).clamp(0, size - 1)
    matrix = kernel.new_zeros(size, size)
    return matrix.index_put_((rows, columns), kernel.expand(size, -1), accumulate=True)
