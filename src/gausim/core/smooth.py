"""Smooth motions of a scene: a basis of displacements, independent of any dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class SmoothMotions:
    """A basis of M motions of one scene, scaled to about equal elastic energy."""

    # displacement of every kernel by each motion [scene units]; zero where pinned or never simulated
    kernels: Float[Tensor, "K 3 M"]
    displacement_gradients: Float[Tensor, "N 3 3 M"]  # one per unit; the last row belongs to kernels that never move
    unit_of_kernel: Int[Tensor, " K"]  # the unit of each kernel: its row in ``displacement_gradients``
    sizes: Float[Tensor, " M"]  # amplitudes of the motions [typical displacements of the template]

    @property
    def count(self) -> int:
        """Number of motions M."""
        return self.sizes.shape[0]

    def displacements(self, coordinates: Float[Tensor, "B M"]) -> Float[Tensor, "B K 3"]:
        """Displacements of the kernels [scene units]."""
        return torch.einsum("kim,bm->bki", self.kernels, coordinates)

    def deformations(self, coordinates: Float[Tensor, "B M"]) -> Float[Tensor, "B N 3 3"]:
        """Deformation gradients of the units."""
        identity = torch.eye(3, dtype=coordinates.dtype, device=coordinates.device)
        return identity + torch.einsum("nijm,bm->bnij", self.displacement_gradients, coordinates)

    def to(self, like: Tensor) -> SmoothMotions:
        """The same motions with the data type and device of ``like``."""
        kernels, gradients, sizes = (x.to(like) for x in (self.kernels, self.displacement_gradients, self.sizes))
        return SmoothMotions(kernels, gradients, self.unit_of_kernel.to(like.device), sizes)
