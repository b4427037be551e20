"""Particles that represent a scene in the simulation, and the kernels that follow them (PhysDreamer, PhysGaussian)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import GaussianScene, SceneError
from gausim.ops.clustering import k_means
from gausim.ops.deformation import bounded_deformation, polar_rotation

# Number of particles that a kernel follows (PhysDreamer).
FOLLOWED = 8
# A kernel keeps its shape where its deformation gradient shrinks volume below this fraction.
LEAST_VOLUME = 0.05


@dataclass(frozen=True, eq=False)
class Driven:
    """P particles of one scene and its K kernels, all in scene units."""

    rest: Float[Tensor, "P 3"]  # particles at rest
    pinned: Bool[Tensor, " P"]  # particles that never move
    followed: Int[Tensor, "K n"]  # indices of the n particles that every kernel follows
    weights: Float[Tensor, "K n"]  # weights of those particles, with sum 1 for every kernel
    means: Float[Tensor, "K 3"]  # positions of the kernels at rest
    held: Bool[Tensor, " K"]  # kernels that never move: pinned ones and those that are not simulated

    def carried(
        self, x: Float[Tensor, "P 3"], deformation_gradients: Float[Tensor, "P 3 3"]
    ) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3 3"], Float[Tensor, "K 3 3"]]:
        """Positions, deformation gradients and rotations of the kernels, from positions and F of the particles.

        Particle p maps X to x_p + F_p (X - X_p); a kernel follows the weighted mean of its particles' maps.
        """
        middle = self.rest.mean(0)  # maps about a nearby point have less rounding error
        offset = x - middle - (deformation_gradients @ (self.rest - middle)[..., None])[..., 0]
        values = torch.cat((deformation_gradients.flatten(1), offset), 1)
        gathered = values.index_select(0, self.followed.flatten()).unflatten(0, self.followed.shape)
        mean = torch.einsum("kn,knc->kc", self.weights, gathered)
        found, shift = mean[:, :9].unflatten(1, (3, 3)), mean[:, 9:]
        positions = middle + shift + (found @ (self.means - middle)[..., None])[..., 0]
        identity = torch.eye(3).to(found)
        found = torch.where(self.held[:, None, None], identity, found)
        found = bounded_deformation(found, LEAST_VOLUME, unit=False)
        return torch.where(self.held[:, None], self.means, positions), found, polar_rotation(found)


def clustered(scene: GaussianScene, most: int, interior: Float[Tensor, "M 3"] | None = None) -> Driven:
    """At most ``most`` driving particles by k-means of the simulated kernels and of ``interior`` points [scene units].

    Pinned kernels and points form separate clusters, in proportion.

    Raises:
        SceneError: fewer simulated kernels than the particles that each kernel follows.
    """
    points, pinned = (v.cpu().numpy() for v in _with_interior(scene, scene.simulated, interior))
    points = points.astype(np.float64)
    if len(points) < FOLLOWED:
        raise SceneError(
            f"{scene.name}: expected at least {FOLLOWED} simulated kernels (each follows that many particles), got "
            f"{len(points)}. Widen the mask 'simulated'."
        )
    most = max(FOLLOWED, min(most, len(points)))
    held = min(int(pinned.sum()), max(1, round(most * float(pinned.mean())))) if pinned.any() else 0
    parts = [k_means(points[chosen], count) for chosen, count in ((~pinned, most - held), (pinned, held)) if count]
    rest = torch.from_numpy(np.concatenate(parts)).to(scene.means.dtype)
    return follow(scene, rest, torch.arange(len(rest)) >= len(rest) - held, FOLLOWED)


def opaque(scene: GaussianScene, least: float, interior: Float[Tensor, "M 3"] | None = None) -> Driven:
    """Simulated kernels of more opacity than ``least`` and ``interior`` points as particles; others follow the nearest.

    Raises:
        SceneError: no simulated kernel is opaque enough.
    """
    chosen = scene.simulated & (torch.sigmoid(scene.opacity_logits) > least)
    if not bool(chosen.any()):
        raise SceneError(f"{scene.name}: no simulated kernel has an opacity above {least}. Lower model.method.opacity.")
    return follow(scene, *_with_interior(scene, chosen, interior), 1)


def _with_interior(
    scene: GaussianScene, chosen: Bool[Tensor, " K"], interior: Float[Tensor, "M 3"] | None
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, " P"]]:
    """Chosen kernels with interior points, and their pins: a point is pinned if its nearest kernel is."""
    points, pinned = scene.means[chosen], scene.pinned[chosen]
    if interior is None:
        return points, pinned
    nearest = cKDTree(points.double().cpu().numpy()).query(interior.double().cpu().numpy())[1]
    return torch.cat((points, interior.to(points))), torch.cat((pinned, pinned[torch.from_numpy(nearest).long()]))


def follow(scene: GaussianScene, rest: Float[Tensor, "P 3"], pinned: Bool[Tensor, " P"], count: int) -> Driven:
    """Every kernel follows its ``count`` nearest particles, with weights proportional to 1 / distance."""
    ranks = list(range(1, min(count, len(rest)) + 1))
    distance, index = cKDTree(rest.double().cpu().numpy()).query(scene.means.double().cpu().numpy(), ranks)
    weights = torch.from_numpy(1 / np.maximum(distance, 1e-6 * scene.diagonal))
    weights = (weights / weights.sum(1, keepdim=True)).to(scene.means)
    held = scene.pinned | ~scene.simulated
    return Driven(rest, pinned, torch.from_numpy(index).long(), weights, scene.means, held)
