"""The lever head: gradients that move a unit by a given shift."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Levers shorter than this move by less than they are told: no gradient moves a unit on its parent [diagonals].
SHORT = 0.03
# Floor of a lever's length [diagonals].
TINY = 1e-4
# Smallest factor by which a lever is shortened along itself before the shape gives way.
MIN_ALONG = 0.2


def lever_gradient(
    shift: Float[Tensor, "N 3"], lever: Float[Tensor, "N 3"], length: Float[Tensor, "N 1"], *, conserve_mass: bool
) -> Float[Tensor, "N 3 3"]:
    """The gradient that takes the lever w from the parent to w + s; zero shift gives the identity.

    F = (w + s) w^T / |w|^2 + d (I - w w^T / |w|^2) with d = (1 + s.w / |w|^2)^(-1/2), so that det F = 1; d = 1 without
    mass conservation. A translation of a unit is linear in s, where a rotation about the parent would be needed else.

    Args:
        shift: s [scene units]; it is scaled by |w|^2 / (|w|^2 + (SHORT length)^2).
        lever: w = x_i - x_p before the unit's own gradient [scene units].
        length: diagonal of each unit's scene [scene units].
        conserve_mass: whether det F = 1.
    """
    square = lever.square().sum(-1, keepdim=True)
    shift = shift * (square / (square + (SHORT * length).square()))
    square = square + (TINY * length).square()
    along = lever[:, :, None] * lever[:, None, :] / square[:, :, None]
    identity = torch.eye(3, dtype=lever.dtype, device=lever.device)
    across = identity - along
    if conserve_mass:
        stretch = (1 + (shift * lever).sum(-1, keepdim=True) / square).clamp_min(MIN_ALONG)
        across = across * stretch.rsqrt()[:, :, None]
    return along + shift[:, :, None] * lever[:, None, :] / square[:, :, None] + across
