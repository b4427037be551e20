"""Body axes, in which predictions are equivariant to rotations of the scene."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.step.recursion import Solved
from gausim.ops.selection import require_pinned

# Least distance between the centres of pinned and free kernels for which it defines the first axis [diagonals].
CLEAR = 1e-2


def body_axes(scene: GaussianScene) -> np.ndarray:
    """Axes of a scene's body (3, 3), as rows: a rotation determined by the body's shape and its pins alone.

    The first points from the centre of the pinned kernels to that of the free ones; where these coincide, it is the
    longest principal axis. The second is the widest direction perpendicular to it; the sign of principal axes is that
    of the third moment. The second axis is undefined for a body that is symmetric about the first.
    """
    require_pinned(scene)
    rest = scene.means[scene.simulated].double().cpu().numpy()
    pinned = scene.pinned[scene.simulated].cpu().numpy()
    centre = rest[~pinned].mean(0)
    offset = rest - centre
    first = centre - rest[pinned].mean(0) if pinned.any() else np.zeros(3)
    if np.linalg.norm(first) < CLEAR * scene.diagonal:
        first = _signed(np.linalg.eigh(offset.T @ offset)[1][:, -1], offset)
    first = first / np.linalg.norm(first)
    across = offset - (offset @ first)[:, None] * first
    second = _signed(np.linalg.eigh(across.T @ across)[1][:, -1], across)
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.stack((first, second, np.cross(first, second)))


def _signed(axis: np.ndarray, offset: np.ndarray) -> np.ndarray:
    third = float(((offset @ axis) ** 3).sum())
    return -axis if third < 0 else axis


@dataclass(frozen=True, eq=False)
class Frames:
    """Body axes and origins of the scenes of a batch, for every unit of every predicted level and for every root."""

    # (N, 3, 3) per level, coarse to fine; rows are the body's axes in scene coordinates
    axes: tuple[Float[Tensor, "_ 3 3"], ...]
    origins: tuple[Float[Tensor, "_ 3"], ...]  # (N, 3) per level [scene units]

    @classmethod
    def of(cls, batch: SceneBatch, axes: Float[Tensor, "S 3 3"], origins: Float[Tensor, "S 3"]) -> "Frames":
        """Selects the axes and origins of a batch from those of all scenes."""
        rows = [batch.scene_index.index_select(0, level.member) for level in batch.levels]
        return cls(tuple(axes[r] for r in rows), tuple(origins[r] for r in rows))

    def into(self, level: int, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Positions of the units of a level (counted coarse to fine) in body axes."""
        return (self.axes[level] @ (positions - self.origins[level])[..., None])[..., 0]

    def turned_back(self, level: int, matrices: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3 3"]:
        """Matrices of the units of a level, from body axes to scene axes."""
        return self.axes[level].mT @ matrices @ self.axes[level]

    def back(self, solved: Solved, rest: Float[Tensor, "N 3"]) -> Solved:
        """The solved finest level in scene axes, for the kernels that inherit from it."""
        last = len(self.axes) - 1
        after = (self.axes[last].mT @ solved.after[..., None])[..., 0] + self.origins[last]
        turned = self.turned_back(last, solved.deformation_gradient)
        rotation = self.turned_back(last, solved.rotation)
        return replace(solved, rest=rest, after=after, deformation_gradient=turned, rotation=rotation)
