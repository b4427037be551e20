"""Anchors: few points whose displacements move and deform all kernels (Spring-Gaus)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import GaussianScene, SceneError
from gausim.ops.deformation import bounded_deformation, polar_rotation

# Number of anchors that a kernel follows, with weights proportional to 1 / sqrt(distance) (Spring-Gaus).
FOLLOWED = 16
# A deformation gradient that shrinks volume below this fraction is replaced by the identity: the fit has failed there.
LEAST_VOLUME = 0.05
# Fraction of the trace added to the moment matrix, which is singular where anchors lie in a plane.
RIDGE = 1e-3


@dataclass(frozen=True, eq=False)
class Anchors:
    """A anchors of one scene and the kernels that follow them; lengths of anchors are in diagonals of the scene."""

    rest: Float[Tensor, "A 3"]  # rest positions [diagonals]
    pinned: Bool[Tensor, " A"]  # anchors that never move
    followed: Int[Tensor, "K n"]  # the n nearest anchors of every kernel
    weights: Float[Tensor, "K n"]  # weights of the anchors' displacements; 0 for held kernels, else they sum to 1
    # factors g_a of the anchors' displacements in the deformation gradient [1 / diagonals]
    slopes: Float[Tensor, "K n 3"]
    means: Float[Tensor, "K 3"]  # rest positions of the kernels [scene units]
    diagonal: float  # diagonal of the scene [scene units]

    @staticmethod
    def of(scene: GaussianScene, most: int) -> "Anchors":
        """Anchors at the centres of the occupied cells of a cubic grid over the simulated kernels.

        The grid is the finest of which at most ``most`` cells are occupied. An anchor is pinned where at least half
        of its cell's kernels are.

        Raises:
            SceneError: fewer than four anchors.
        """
        points = scene.means[scene.simulated].double() / scene.diagonal
        cells, cell_of = _grid(points, most)
        pinned_fraction = torch.zeros(len(cells), dtype=torch.float64).index_add_(
            0, cell_of, scene.pinned[scene.simulated].double()
        ) / torch.bincount(cell_of, minlength=len(cells))
        if len(cells) < 4:
            raise SceneError(
                f"{scene.name}: expected at least 4 occupied grid cells as anchors, got {len(cells)} of {most} allowed "
                f"and {len(points)} simulated kernels. Raise model.method.anchors."
            )
        pinned = pinned_fraction >= 0.5
        if bool(scene.pinned.any()) and not bool(pinned.any()):
            pinned = pinned_fraction > 0
        held = scene.pinned | ~scene.simulated
        followed, weights, slopes = _follow(scene.means.double() / scene.diagonal, cells, held)
        single = [x.to(scene.means.dtype) for x in (cells, weights, slopes)]
        return Anchors(single[0], pinned, followed, single[1], single[2], scene.means, scene.diagonal)

    @property
    def free(self) -> Float[Tensor, "A 1"]:
        """1 for anchors that may move, 0 for pinned ones."""
        return (~self.pinned).to(self.rest)[:, None]

    def positions(self, displacement: Float[Tensor, "A 3"]) -> Float[Tensor, "K 3"]:
        """Positions of the kernels [scene units] from the displacements of the anchors [diagonals]."""
        moved = torch.einsum("kn,kni->ki", self.weights.to(displacement), self._gather(displacement))
        return self.means.to(displacement) + self.diagonal * moved

    def deformation_gradients(
        self, displacement: Float[Tensor, "A 3"]
    ) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3 3"]]:
        """Deformation gradients and rotations of the kernels.

        F minimises sum_a w_a |F (X_a - X) - (x_a - x)|^2 with X, x the weighted means of the followed anchors:
        F = I + sum_a u_a g_a^T, g_a = w_a M^-1 (X_a - X), M = sum_a w_a (X_a - X)(X_a - X)^T. The rotation is that of
        the polar decomposition of F.
        """
        slopes = self.slopes.to(displacement)
        identity = torch.eye(3).to(slopes)
        found = identity + torch.einsum("kni,knj->kij", self._gather(displacement), slopes)
        found = bounded_deformation(found, LEAST_VOLUME, unit=False)
        return found, polar_rotation(found)

    def _gather(self, displacement: Tensor) -> Tensor:
        return displacement.index_select(0, self.followed.flatten()).unflatten(0, self.followed.shape)


def _grid(points: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Centres of the occupied cells of the finest grid that has at most ``most``, and the cell of every point."""
    low = points.amin(0)
    fine, coarse = 1e-3, 1.0  # of a diagonal; the coarsest grid has at most eight cells
    for _ in range(30):
        middle = (fine * coarse) ** 0.5
        if len(torch.unique(((points - low) / middle).floor(), dim=0)) > most:
            fine = middle
        else:
            coarse = middle
    cells, cell_of = torch.unique(((points - low) / coarse).floor(), dim=0, return_inverse=True)
    return low + (cells + 0.5) * coarse, cell_of


def _follow(points: Tensor, anchors: Tensor, held: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest anchors of every kernel, their weights and their slopes; both 0 where a kernel is held."""
    distance, index = cKDTree(anchors.numpy()).query(points.numpy(), k=min(FOLLOWED, len(anchors)))
    followed = torch.from_numpy(index).long()
    weights = torch.from_numpy(distance).clamp_min(1e-6).rsqrt()
    weights = weights / weights.sum(1, keepdim=True)
    near = anchors[followed]
    offset = near - (weights[..., None] * near).sum(1, keepdim=True)
    moment = torch.einsum("kn,kni,knj->kij", weights, offset, offset)
    trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1)
    moment = moment + RIDGE * trace[:, None, None] * torch.eye(3, dtype=moment.dtype)
    slopes = torch.linalg.solve(moment, (weights[..., None] * offset).mT).mT
    free = (~held)[:, None]
    return followed, weights * free, slopes * free[..., None]
