"""Fast form of :func:`gausim.data.images.over_black`."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from gausim.kernels.jit import KERNEL


@numba.njit(**KERNEL)
def _over_black(frames, rgb, alpha):
    """The same operations as in torch, so the same bits, but in one pass; all three lie flat in memory."""
    full = np.float32(255)
    for i in range(alpha.shape[0]):
        a = np.float32(frames[4 * i + 3]) / full
        alpha[i] = a
        rgb[3 * i] = np.float32(frames[4 * i]) / full * a
        rgb[3 * i + 1] = np.float32(frames[4 * i + 1]) / full * a
        rgb[3 * i + 2] = np.float32(frames[4 * i + 2]) / full * a


def over_black(frames: Tensor) -> tuple[Tensor, Tensor]:
    """RGB and alpha."""
    rgb, alpha = torch.empty(*frames.shape[:-1], 3), torch.empty(frames.shape[:-1])
    _over_black(frames.contiguous().numpy().reshape(-1), rgb.numpy().reshape(-1), alpha.numpy().reshape(-1))
    return rgb, alpha
