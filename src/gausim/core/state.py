"""States (the input of a step), trajectories (the output of a rollout), and smooth motions without any dynamics."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core.scene import GaussianScene


@dataclass(frozen=True, eq=False)
class SimState:
    """The state of the dynamics is the kernels' two latest positions, and for models with memory those before."""

    positions: Float[Tensor, "K 3"]  # x_t of all K kernels of the scene [scene units]
    previous: Float[Tensor, "K 3"]  # x_{t-1}, one frame earlier
    older: tuple[Float[Tensor, "K 3"], ...] = ()  # x_{t-2}, x_{t-3}, ..., where they are known

    def detach(self) -> "SimState":
        """The same values, detached from the graph of loss gradients."""
        return SimState(self.positions.detach(), self.previous.detach(), tuple(x.detach() for x in self.older))

    def remembering(self, count: int) -> "SimState":
        """The state with ``count`` older frames; those that are not known continue the motion backwards evenly."""
        older, last, step = list(self.older[:count]), self.previous, self.positions - self.previous
        if older:
            last, step = older[-1], (older[-2] if len(older) > 1 else self.previous) - older[-1]
        while len(older) < count:
            last = last - step
            older.append(last)
        return SimState(self.positions, self.previous, tuple(older))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """F frames of one scene, frame 0 being the initial state.

    Kernel k of frame f has mean ``positions[f, k]``, covariance G S_k G^T with
    G = ``deformation_gradients[f, unit_of_kernel[k]]``, and its colour is looked up at Q^T d with Q the rotation of the
    same unit.
    """

    positions: Float[Tensor, "F K 3"]  # kernel means [scene units]
    # accumulated deformation gradients of the N units that carry kernels
    deformation_gradients: Float[Tensor, "F N 3 3"]
    rotations: Float[Tensor, "F N 3 3"]  # accumulated rotations of these units
    # the unit of each kernel; pinned and never-simulated kernels point to an identity unit
    unit_of_kernel: Int[Tensor, " K"]
    fps: float  # frames per second

    @property
    def frames(self) -> int:
        """Number of frames F, the initial state included."""
        return self.positions.shape[0]

    def to(self, device: torch.device | str) -> "Trajectory":
        """The same on a device."""
        return Trajectory(
            self.positions.to(device), self.deformation_gradients.to(device), self.rotations.to(device),
            self.unit_of_kernel.to(device), self.fps,
        )  # fmt: skip

    def part(self, frames: slice) -> "Trajectory":
        """The chosen frames."""
        states = self.positions[frames], self.deformation_gradients[frames], self.rotations[frames]
        return Trajectory(*states, self.unit_of_kernel, self.fps / (frames.step or 1))

    def carry(self, points: Float[Tensor, "P 3"], kernel: Int[Tensor, " P"], rest: Float[Tensor, "K 3"]) -> Tensor:
        """Moves rest-space points with the unit of the kernel they are attached to, (F, P, 3).

        A point s attached to kernel k goes to x_k + G (X_s - X_k), which for a kernel of unit c is
        x_c + G_c (X_s - X_c) (METHOD section 5, the 3D error).
        """
        gradient = self.deformation_gradients[:, self.unit_of_kernel[kernel]]
        offset = (points - rest[kernel]).to(gradient)
        return self.positions[:, kernel] + torch.einsum("fpij,pj->fpi", gradient, offset)


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

    def to(self, like: Tensor) -> "SmoothMotions":
        """The same motions with the data type and device of ``like``."""
        kernels, gradients, sizes = (x.to(like) for x in (self.kernels, self.displacement_gradients, self.sizes))
        return SmoothMotions(kernels, gradients, self.unit_of_kernel.to(like.device), sizes)


def initial_sway(scene: GaussianScene, fraction: float) -> SimState:
    """The rest state with an initial sway: every free kernel moves along x, faster when farther from the roots.

    ``fraction`` is the displacement per frame of the kernel farthest from the pins [diagonals].
    """
    free = scene.simulated & ~scene.pinned
    root = scene.means[scene.pinned].mean(0)
    distance = torch.where(free, (scene.means - root).norm(dim=-1), torch.zeros(()))
    shift = torch.zeros_like(scene.means)
    shift[:, 0] = fraction * scene.diagonal * distance / distance.max().clamp_min(1e-12)
    return SimState(scene.means, scene.means - shift)
