"""Smooth motions of a scene: what its template can carry, at every kernel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.hierarchy import Hierarchy


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

    @staticmethod
    def of(
        scene: GaussianScene,
        hierarchy: Hierarchy,
        finest: int,
        motions: tuple[Float[Tensor, "N 3 M"], Float[Tensor, "N 3 3 M"], Float[Tensor, " M"]],
    ) -> SmoothMotions:
        """Carries motions of units to their kernels: unit displacement plus its gradient times the offset in the unit.

        Args:
            scene: the scene.
            hierarchy: its units.
            finest: level of the units that move.
            motions: displacements and gradients of the units by each motion, and its size (see ``sizes``).
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
