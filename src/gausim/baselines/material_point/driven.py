"""Particles of a scene that are simulated, and the kernels that follow them (PhysDreamer, PhysGaussian)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import GaussianScene, SceneError
from gausim.ops.clustering import k_means
from gausim.ops.deformation import bounded_deformation, polar_rotation

# Kernels follow so many particles (PhysDreamer).
FOLLOWED = 8
# A gradient that shrinks volume below this fraction would turn a kernel inside out; the kernel keeps its shape then.
LEAST_VOLUME = 0.05


@dataclass(frozen=True, eq=False)
class Driven:
    """P particles of one scene and its K kernels, all in scene units.

    Attributes:
        rest: particles at rest.
        pinned: those that never move.
        followed: the n particles that every kernel follows.
        weights: how much each counts; they sum to 1.
        means: kernels at rest.
        held: kernels that never move: pinned ones and those that are not simulated.
    """

    rest: Float[Tensor, "P 3"]
    pinned: Bool[Tensor, " P"]
    followed: Int[Tensor, "K n"]
    weights: Float[Tensor, "K n"]
    means: Float[Tensor, "K 3"]
    held: Bool[Tensor, " K"]

    @property
    def count(self) -> int:
        """Number of particles P."""
        return len(self.rest)

    def to(self, device: torch.device) -> Driven:
        """The same on another device."""
        names = ("rest", "pinned", "followed", "weights", "means", "held")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def carried(
        self, x: Float[Tensor, "P 3"], gradient: Float[Tensor, "P 3 3"]
    ) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3 3"], Float[Tensor, "K 3 3"]]:
        """Positions, gradients and rotations of kernels that each particle p would map to x_p + F_p (X - X_p).

        A kernel follows the weighted mean of the maps of its particles; its gradient is the mean of theirs.

        Args:
            x: where the particles are now.
            gradient: F of the particles.
        """
        middle = self.rest.mean(0)  # maps about a point nearby: less rounding
        offset = x - middle - (gradient @ (self.rest - middle)[..., None])[..., 0]
        mean = self._mean(torch.cat((gradient.flatten(1), offset), 1))
        own, shift = mean[:, :9].unflatten(1, (3, 3)), mean[:, 9:]
        positions = middle + shift + (own @ (self.means - middle)[..., None])[..., 0]
        identity = torch.eye(3).to(own)
        own = torch.where(self.held[:, None, None], identity, own)
        own = bounded_deformation(own, LEAST_VOLUME, unit=False)
        return torch.where(self.held[:, None], self.means, positions), own, polar_rotation(own)

    def turned(
        self, x: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3 3"], Float[Tensor, "K 3 3"]]:
        """Positions by the mean displacement of the particles, and their Kabsch rotation twice; shapes are kept.

        Gradients flow through the positions only: where particles are in line, the rotation has none.

        Args:
            x: where the particles are now.
        """
        positions = self.means + self._mean(x - self.rest)
        with torch.no_grad():
            before, now = (p[self.followed] - p[self.followed].mean(1, keepdim=True) for p in (self.rest, x))
            u, _, vt = torch.linalg.svd(now.mT @ before)
            sign = torch.ones_like(u[..., 0])
            sign[:, 2] = torch.linalg.det(u @ vt).sign()
            rotation = (u * sign[:, None, :]) @ vt
            rotation = torch.where(self.held[:, None, None], torch.eye(3).to(rotation), rotation)
        return torch.where(self.held[:, None], self.means, positions), rotation, rotation

    def _mean(self, values: Float[Tensor, "P c"]) -> Float[Tensor, "K c"]:
        gathered = values.index_select(0, self.followed.flatten()).unflatten(0, self.followed.shape)
        return torch.einsum("kn,knc->kc", self.weights, gathered)


def clustered(
    scene: GaussianScene, filled: Float[Tensor, "M 3"], most: int, *, followed: int = FOLLOWED, even: bool = False
) -> Driven:
    """Driving particles by k-means of the simulated kernels and filled points; pinned ones by themselves.

    A filled point is pinned if its nearest kernel is.

    Args:
        scene: the rest scene.
        filled: points within the object [scene units].
        most: at most so many particles.
        followed: a kernel follows so many.
        even: they count alike (PhysDreamer); else with weights proportional to 1 / distance.

    Raises:
        SceneError: there are fewer points than a kernel shall follow particles.
    """
    kernels = scene.means[scene.simulated].double().cpu().numpy()
    points = np.concatenate((kernels, filled.double().cpu().numpy()))
    of_kernel = scene.pinned[scene.simulated].cpu().numpy()
    pinned = np.concatenate((of_kernel, of_kernel[cKDTree(kernels).query(points[len(kernels) :])[1]]))
    if len(points) < followed:
        raise SceneError(
            f"{scene.name}: expected at least {followed} simulated kernels (each follows so many particles), got "
            f"{len(points)}. Widen the mask 'simulated'."
        )
    most = max(followed, min(most, len(points)))
    held = min(int(pinned.sum()), max(1, round(most * float(pinned.mean())))) if pinned.any() else 0
    parts = [k_means(points[chosen], count) for chosen, count in ((~pinned, most - held), (pinned, held)) if count]
    rest = torch.from_numpy(np.concatenate(parts)).to(scene.means.dtype)
    marks = torch.arange(len(rest)) >= len(rest) - held
    return follow(scene, rest, marks, followed, even=even)


def opaque(scene: GaussianScene, filled: Float[Tensor, "M 3"], least: float) -> Driven:
    """Every simulated kernel that is opaque enough is a particle, as is every filled point; others follow the nearest.

    Args:
        scene: the rest scene.
        filled: points within the object [scene units]; pinned where the nearest particle is.
        least: opacity above which a kernel is a particle.

    Raises:
        SceneError: no simulated kernel is opaque enough.
    """
    chosen = scene.simulated & (torch.sigmoid(scene.opacity_logits) > least)
    if not bool(chosen.any()):
        raise SceneError(f"{scene.name}: no simulated kernel has an opacity above {least}. Lower model.method.opacity.")
    own = scene.means[chosen]
    nearest = cKDTree(own.cpu().numpy()).query(filled.cpu().numpy())[1]
    pinned = scene.pinned[chosen]
    return follow(
        scene, torch.cat((own, filled.to(own))), torch.cat((pinned, pinned[torch.from_numpy(nearest).long()])), 1
    )


def follow(
    scene: GaussianScene, rest: Float[Tensor, "P 3"], pinned: Bool[Tensor, " P"], count: int, *, even: bool = False
) -> Driven:
    """Every kernel follows its ``count`` nearest particles, with equal weights or ones proportional to 1 / distance."""
    ranks = list(range(1, min(count, len(rest)) + 1))
    distance, index = cKDTree(rest.double().cpu().numpy()).query(scene.means.double().cpu().numpy(), ranks)
    weights = torch.from_numpy(np.ones_like(distance) if even else 1 / np.maximum(distance, 1e-6 * scene.diagonal))
    weights = (weights / weights.sum(1, keepdim=True)).to(scene.means)
    held = scene.pinned | ~scene.simulated
    return Driven(rest, pinned, torch.from_numpy(index).long(), weights, scene.means, held)
