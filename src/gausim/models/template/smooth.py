"""Smooth motions of a scene: the template's modes at every kernel."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import GaussianScene, SmoothMotions
from gausim.models.hierarchy.clusters import Hierarchy


def smooth_motions(
    scene: GaussianScene,
    hierarchy: Hierarchy,
    finest: int,
    motions: tuple[Float[Tensor, "N 3 M"], Float[Tensor, "N 3 3 M"], Float[Tensor, " M"]],
) -> SmoothMotions:
    """Extends motions of units to their kernels: the unit's displacement plus its displacement gradient times offset.

    ``motions`` are displacements and displacement gradients of the units, and sizes (see ``SmoothMotions.sizes``).
    """
    modes, gradients, sizes = motions
    unit = hierarchy.ancestor(0, finest)
    offset = scene.means[hierarchy.kernels] - hierarchy.levels[finest].rest[unit]
    moved = modes[unit] + torch.einsum("kabm,kb->kam", gradients[unit], offset)
    kernels = moved.new_zeros(scene.count, 3, modes.shape[-1])
    kernels[hierarchy.kernels] = moved * ~hierarchy.levels[0].pinned[:, None, None]
    still = torch.full((scene.count,), len(modes))
    rows = torch.cat((gradients, torch.zeros_like(gradients[:1])))
    return SmoothMotions(kernels, rows, still.index_copy(0, hierarchy.kernels, unit), sizes)
