"""The hierarchy of kernels and centre-of-mass systems, with their parents and roots (METHOD section 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import GaussianScene
from gausim.ops.clustering import ball_clusters
from gausim.ops.covariance import kernel_volumes
from gausim.ops.selection import require_pinned


@dataclass(frozen=True, eq=False)
class Level:
    """One level of N units."""

    rest: Float[Tensor, "N 3"]  # centres of mass at rest with unit density [scene units]
    volume: Float[Tensor, " N"]  # volumes V_c = sum of V_i
    # units of pinned kernels, which never move; no cluster has both pinned and free kernels
    pinned: Bool[Tensor, " N"]
    parent: Int[Tensor, " M"]  # the unit of the next level that contains each unit; empty at the top level
    # the nearest pinned kernel (index into the simulated kernels), the parent of a top unit; of a free body the kernel
    # nearest to its centre
    root: Int[Tensor, " N"]

    @property
    def count(self) -> int:
        """Number of units."""
        return self.rest.shape[0]


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Levels 0 (the simulated kernels) to L of one scene."""

    levels: tuple[Level, ...]  # the levels, kernels first
    kernels: Int[Tensor, " K"]  # scene index of each level-0 unit
    diagonal: float  # bounding-box diagonal of the simulated kernels [scene units]; see :func:`build_hierarchy`
    law: str = "solid"  # of the scene

    def ancestor(self, fine: int, coarse: int) -> Int[Tensor, " N"]:
        """The unit of level ``coarse`` that contains each unit of level ``fine``."""
        index = torch.arange(self.levels[fine].count)
        for level in range(fine, coarse):
            index = self.levels[level].parent[index]
        return index

    def predictions(self, predicted: Sequence[int]) -> int:
        """N_F: number of deformation gradients that a step predicts (none for pinned units)."""
        return sum(int((~self.levels[level].pinned).sum()) for level in predicted)


def build_hierarchy(scene: GaussianScene, *, radii: Sequence[float], axes: np.ndarray | None = None) -> Hierarchy:
    """Clusters the simulated kernels level by level.

    Args:
        scene: the rest scene; at least one kernel must be pinned, unless it is free.
        radii: largest cluster diameter per level 1..L, as fractions of the bounding-box diagonal.
        axes: (3, 3), rows are the axes of the bounding box whose diagonal is the unit of length; the scene's axes when
            None. With body axes the units do not depend on the orientation of the scene.

    Raises:
        SceneError: no pinned kernel, or no free simulated kernel.
    """
    require_pinned(scene)
    index = scene.simulated.nonzero()[:, 0].cpu()
    rest = scene.means.cpu()[index].double()
    volume = kernel_volumes(scene.log_scales.cpu()[index].double(), scene.volume_scale)
    pinned = scene.pinned.cpu()[index]
    # Kernels that move together: the free ones, and those of each hand.
    group = torch.where(pinned, 1, 0) if scene.hand is None else torch.where(pinned, scene.hand.cpu()[index] + 2, 0)
    # The root of a body that nothing holds is the kernel nearest to the mean.
    roots = (pinned.nonzero()[:, 0] if pinned.any() else (rest - rest.mean(0)).norm(dim=1).argmin()[None]).numpy()
    own = np.eye(3) if axes is None else axes
    diagonal = scene.diagonal if axes is None else float(np.linalg.norm(np.ptp(rest.numpy() @ axes.T, axis=0)))
    tree = cKDTree(rest[roots].numpy())
    levels = []
    for number in range(len(radii) + 1):
        root = torch.from_numpy(roots[tree.query(rest.numpy())[1]])
        top = number == len(radii)
        parent = torch.zeros(0, dtype=torch.int64)
        if not top:
            parent = _cluster_by_group(rest.numpy() @ own.T, group, radii[number] * diagonal)
        levels.append(Level(rest.to(scene.means.dtype), volume.to(scene.means.dtype), pinned, parent, root))
        if not top:
            rest, volume, group = _coarsen(rest, volume, group, parent)
            pinned = group > 0
    return Hierarchy(tuple(levels), index, diagonal, scene.law)


def _cluster_by_group(rest: np.ndarray, group: Tensor, diameter: float) -> Tensor:
    """Labels of clusters within each group; those of free units, group 0, are numbered first."""
    labels = torch.zeros(len(rest), dtype=torch.int64)
    offset = 0
    for mask in (group == number for number in group.unique()):
        group_labels = ball_clusters(np.ascontiguousarray(rest[mask.numpy()]), diameter)
        labels[mask] = torch.from_numpy(group_labels) + offset
        offset += int(group_labels.max()) + 1
    return labels


def _coarsen(rest: Tensor, volume: Tensor, group: Tensor, parent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    count = int(parent.max()) + 1
    total = torch.zeros(count, dtype=volume.dtype).index_add(0, parent, volume)
    centre = torch.zeros(count, 3, dtype=rest.dtype).index_add(0, parent, rest * volume[:, None]) / total[:, None]
    return centre, total, torch.zeros(count, dtype=group.dtype).index_copy(0, parent, group)
