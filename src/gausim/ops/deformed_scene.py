"""Export of one frame of a trajectory as a scene for any 3DGS viewer."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from gausim.core import GaussianScene
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.spherical_harmonics import spherical_harmonics_basis

# Directions in which rotated colours are sampled; twice the 16 unknowns of degree 3.
_DIRECTIONS = 32
# Largest deviation of G and Q from the identity at which a kernel's fields are copied unchanged.
_UNMOVED = 1e-7
_KERNELS_AT_ONCE = 8192


def deformed_scene(
    scene: GaussianScene,
    positions: Float[Tensor, "K 3"],
    deformation_gradients: Float[Tensor, "N 3 3"],
    rotations: Float[Tensor, "N 3 3"],
    unit_of_kernel: Int[Tensor, " K"],
) -> GaussianScene:
    """The scene in a deformed state.

    Covariances G S G^T are decomposed into axes and lengths, and spherical harmonics are rotated by Q, so that other
    viewers show the same image as this package. Kernels of undeformed units keep their fields bit for bit.
    """
    identity = torch.eye(3, dtype=deformation_gradients.dtype, device=deformation_gradients.device)
    change = torch.maximum(
        (deformation_gradients - identity).abs().amax((1, 2)), (rotations - identity).abs().amax((1, 2))
    )
    moved = (change > _UNMOVED)[unit_of_kernel]
    log_scales, quats, sh = scene.log_scales.clone(), scene.quats.clone(), scene.sh.clone()
    for index in moved.nonzero()[:, 0].split(_KERNELS_AT_ONCE):
        deformation_gradient = deformation_gradients[unit_of_kernel[index]].double()
        covars = covariance_from_scales(scene.log_scales[index].double(), scene.quats[index].double())
        lengths, axes = torch.linalg.eigh(deformation_gradient @ covars @ deformation_gradient.mT)
        # Reflections are turned into rotations by the sign of one axis, which leaves the covariance unchanged.
        axes = torch.cat((axes[..., :2], axes[..., 2:] * torch.det(axes)[:, None, None]), -1)
        log_scales[index] = (0.5 * lengths.clamp_min(1e-30).log()).to(log_scales)
        quats[index] = matrix_to_quaternion(axes).to(quats)
        sh[index] = rotate_sh(scene.sh[index], rotations[unit_of_kernel[index]])
    return replace(scene, means=positions.to(scene.means), log_scales=log_scales, quats=quats, sh=sh)


def matrix_to_quaternion(rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions w x y z with w >= 0 of rotation matrices."""
    quats = Rotation.from_matrix(rotation.cpu().numpy()).as_quat(canonical=True, scalar_first=True)
    return torch.from_numpy(quats).to(rotation)


def rotate_sh(sh: Float[Tensor, "n B 3"], rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n B 3"]:
    """Coefficients c' with sum c'_b Y_b(d) = sum c_b Y_b(Q^T d) for every direction d.

    Rotations map each degree to itself, so the least-squares fit on enough directions is exact.
    """
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
    if degree == 0:
        return sh.clone()
    directions = _spread_directions().to(sh.device)
    turned = directions @ rotation.double()  # rows d^T Q, (n, directions, 3)
    colors = spherical_harmonics_basis(degree, turned) @ sh.double()
    inverse = torch.linalg.pinv(spherical_harmonics_basis(degree, directions))
    return (inverse @ colors).to(sh)


def _spread_directions() -> Float[Tensor, "directions 3"]:
    """Unit vectors on a Fibonacci spiral, evenly over the sphere."""
    number = torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1 - 2 * number / _DIRECTIONS
    angle = number * torch.pi * (3 - 5**0.5)
    radius = (1 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)
