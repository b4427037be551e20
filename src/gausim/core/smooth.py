"""Smooth motions of a scene: a basis in which it can be placed without any dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class SmoothMotions:
    """A basis of M motions of one scene, of sizes at which each costs about the same elastic energy.

    Attributes:
        kernels: displacement of every kernel by each motion [scene units]; zero where pinned or never simulated.
        gradients: displacement gradient of every unit; the last row is of what never moves.
        unit_of_kernel: the unit of each kernel, a row of ``gradients``.
        sizes: what the sizes are, as multiples of the template's own typical displacement.
    """

    kernels: Float[Tensor, "K 3 M"]
    gradients: Float[Tensor, "N 3 3 M"]
    unit_of_kernel: Int[Tensor, " K"]
    sizes: Float[Tensor, " M"]

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
        return identity + torch.einsum("nijm,bm->bnij", self.gradients, coordinates)

    def to(self, like: Tensor) -> SmoothMotions:
        """The same in the type and on the device of ``like``."""
        moved = (self.kernels.to(like), self.gradients.to(like), self.unit_of_kernel.to(like.device))
        return SmoothMotions(*moved, self.sizes.to(like))
