"""LPIPS 0.1 with AlexNet (Zhang et al. 2018): distance of deep features, with weights fitted to human judgements.

The weights are not part of this package: `gausim prepare lpips` downloads and converts the published files.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from gausim.core import ConfigError, DataError
from gausim.metrics.image import ImageMetric, Images, Mask, PerImage

WEIGHTS_VARIABLE = "GAUSIM_LPIPS_WEIGHTS"
NO_WEIGHTS = "no weights"
HOW_TO_GET_WEIGHTS = "gausim prepare lpips"
# Note under tables without LPIPS.
NO_LPIPS = f"LPIPS was not measured, its weights are not there: `{HOW_TO_GET_WEIGHTS}` gets them; then evaluate again."
# Mean and deviation for the normalisation of images in [-1, 1].
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# AlexNet's five convolutions: output channels, input channels, size of the kernel; stride and padding.
SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
_STRIDES, _PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED_BEFORE = (1, 2)
# Smallest side of an image that leaves pixels for the second pooling.
SMALLEST = 31
TOO_SMALL = f"images under {SMALLEST} pixels"


def weights_path() -> Path:
    """Path of the weights: $GAUSIM_LPIPS_WEIGHTS, else gausim/lpips_alexnet.safetensors in the cache."""
    named = os.environ.get(WEIGHTS_VARIABLE)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(named) if named else cache / "gausim" / "lpips_alexnet.safetensors"


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the arrays of a weights file: conv0..4 (weight, bias) and the linear heads lin0..4."""
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (out, into, size) in enumerate(SHAPES):
        shapes |= {f"conv{i}.weight": (out, into, size, size), f"conv{i}.bias": (out,), f"lin{i}.weight": (out,)}
    return shapes


def check_weights(weights: Mapping[str, Tensor], source: str) -> None:
    """Checks that arrays are LPIPS weights.

    Raises:
        DataError: an array is missing, of another shape or not finite, or a linear head is negative.
    """
    for name, shape in expected_shapes().items():
        found = weights.get(name)
        actual = None if found is None else tuple(found.shape)
        if found is None or actual != shape or not bool(torch.isfinite(found).all()):
            raise DataError(
                f"{source}: array '{name}' must be finite and of shape {shape}, got {actual}. "
                f"Convert the weights again: {HOW_TO_GET_WEIGHTS}"
            )
        if name.startswith("lin") and bool((found < 0).any()):
            raise DataError(f"{source}: array '{name}' has negative values; the heads of LPIPS have none.")


def read_weights(path: Path) -> dict[str, Tensor]:
    """The arrays of a safetensors file of LPIPS weights.

    Raises:
        DataError: the file cannot be read, or does not contain the weights.
    """
    try:
        arrays = load_file(path)
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: cannot be read as safetensors ({error}). Make it: {HOW_TO_GET_WEIGHTS}") from error
    check_weights(arrays, str(path))
    return {name: arrays[name].float() for name in expected_shapes()}


class LPIPS(ImageMetric):
    """Mean LPIPS distance over images (0 for equal ones; AlexNet features, linear heads of version 0.1).

    Args:
        weights: safetensors file; :func:`weights_path` when None.

    Raises:
        ConfigError: the file does not exist.
        DataError: the file does not contain the weights.
    """

    key, label, scale, unit = "lpips", "LPIPS", 1e2, "1e-2"

    def __init__(self, weights: Path | str | None = None) -> None:
        super().__init__()
        path = Path(weights) if weights is not None else weights_path()
        if not path.is_file():
            raise ConfigError(f"{path}: no such file ({NO_WEIGHTS} for LPIPS). Make it: {HOW_TO_GET_WEIGHTS}")
        self._weights = read_weights(path)

    def per_image(self, prediction: Images, target: Images, mask: Mask) -> PerImage:
        """LPIPS of every image.

        Raises:
            DataError: the images are smaller than 31 pixels.
        """
        if min(target.shape[1:3]) < SMALLEST:
            raise DataError(f"LPIPS: images of {tuple(target.shape[1:3])} pixels, expected at least {SMALLEST} a side.")
        weights = {name: w.to(target) for name, w in self._weights.items()}
        total = target.new_zeros(len(target))
        first, second = _features(prediction, weights), _features(target, weights)
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            difference = (_unit(a) - _unit(b)).square()
            total = total + torch.einsum("bchw,c->b", difference, weights[f"lin{i}.weight"]) / a[0, 0].numel()
        return total


def _features(images: Images, weights: Mapping[str, Tensor]) -> list[Tensor]:
    shift, scale = (images.new_tensor(v)[:, None, None] for v in (_SHIFT, _SCALE))
    x, found = (2 * images.permute(0, 3, 1, 2) - 1 - shift) / scale, []
    for i, (stride, padding) in enumerate(zip(_STRIDES, _PADDING, strict=True)):
        if i in _POOLED_BEFORE:
            x = F.max_pool2d(x, 3, 2)
        x = F.conv2d(x, weights[f"conv{i}.weight"], weights[f"conv{i}.bias"], stride, padding).relu()
        found.append(x)
    return found


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
