"""Images of a deformed scene: covariances, view-dependent colours and the call of a renderer."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from gausim.core import Cameras, ConfigError, GaussianScene, Rendered, Renderer, Trajectory
from gausim.kernels.operations import operation
from gausim.ops.covariance import covariance_from_scales, transport_covariance
from gausim.ops.spherical_harmonics import spherical_harmonics_basis

# Frames that are drawn at a time.
AT_A_TIME = 16


@dataclass(frozen=True, eq=False)
class SceneAppearance:
    """Constants of a scene for drawing, computed once for all frames."""

    covars: Float[Tensor, "n 3 3"]  # rest covariances of the n kernels that are drawn [scene units^2]
    opacities: Float[Tensor, " n"]  # opacities in [0, 1]
    sh: Float[Tensor, "n basis 3"]  # colour coefficients
    sh_degree: int  # their degree, 0..3
    index: Int[Tensor, " n"] | None  # indices of the drawn kernels in the scene; None means all

    @staticmethod
    def of(scene: GaussianScene, mask: Bool[Tensor, " K"] | None = None) -> "SceneAppearance":
        """The appearance of a scene, or of its kernels where ``mask`` holds (e.g. ``scene.foreground``)."""
        index = None
        if mask is not None and not bool(mask.all()):
            index = mask.nonzero()[:, 0]
            scene = scene.select(mask)
        return SceneAppearance(
            covars=covariance_from_scales(scene.log_scales, scene.quats),
            opacities=torch.sigmoid(scene.opacity_logits),
            sh=scene.sh,
            sh_degree=scene.sh_degree,
            index=index,
        )

    def to(self, like: Tensor) -> "SceneAppearance":
        """The same in the type and on the device of ``like``."""
        if self.covars.dtype == like.dtype and self.covars.device == like.device:
            return self
        index = None if self.index is None else self.index.to(like.device)
        return SceneAppearance(
            self.covars.to(like), self.opacities.to(like), self.sh.to(like), self.sh_degree, index
        )  # fmt: skip


def draw(
    renderer: Renderer,
    scene: GaussianScene | SceneAppearance,
    positions: Float[Tensor, "B K 3"],
    deformation_gradients: Float[Tensor, "B N 3 3"],
    rotations: Float[Tensor, "B N 3 3"],
    unit_of_kernel: Int[Tensor, " K"],
    cameras: Cameras,
    *,
    background: Float[Tensor, " 3"] | None = None,
    mask: Bool[Tensor, " K"] | None = None,
) -> Rendered:
    """Draws B deformed states of one scene in every camera (METHOD section 2).

    Kernel k of unit c has covariance G_c S_k G_c^T and the colour of its spherical harmonics at Q_c^T d, d the unit
    vector from the camera to the kernel. Differentiable in ``positions`` [scene units], ``deformation_gradients`` G
    and ``rotations`` Q, and in the tensors of a SceneAppearance, which training computes once in the place of the
    scene. ``mask`` selects kernels of a GaussianScene; the background is black when absent.

    Raises:
        ConfigError: a mask is given with a SceneAppearance.
    """
    if isinstance(scene, GaussianScene):
        scene = SceneAppearance.of(scene, mask)
    elif mask is not None:
        raise ConfigError("draw: expected a mask only beside a GaussianScene. Give it to SceneAppearance.of instead.")
    look = scene.to(positions)
    if look.index is not None:
        positions, unit_of_kernel = positions.index_select(1, look.index), unit_of_kernel[look.index]
    states, views = positions.shape[0], cameras.viewmats.shape[0]
    centers = cameras.centers.to(positions)
    covars, colors = deformed_appearance(
        positions, deformation_gradients, rotations, unit_of_kernel, look.covars, look.sh, centers
    )
    return renderer(
        positions,
        covars,
        colors,
        look.opacities.expand(states, -1),
        cameras.viewmats.to(positions).expand(states, views, 4, 4),
        cameras.Ks.to(positions).expand(states, views, 3, 3),
        (cameras.width, cameras.height),
        background=background,
    )


@operation("gausim.render.cpu.appearance:deformed_appearance")
def deformed_appearance(
    positions: Float[Tensor, "B n 3"],
    deformation_gradients: Float[Tensor, "B N 3 3"],
    rotations: Float[Tensor, "B N 3 3"],
    unit_of_kernel: Int[Tensor, " n"],
    covars: Float[Tensor, "n 3 3"],
    sh: Float[Tensor, "n basis 3"],
    centers: Float[Tensor, "V 3"],
) -> tuple[Float[Tensor, "B n 3 3"], Float[Tensor, "B V n 3"]]:
    """Covariances G S G^T [scene units^2] and colours max(0, 0.5 + sum_b sh_b Y_b(Q^T d)) for each camera.

    Differentiable in all but the camera centres [scene units]; colour coefficients have degree 0..3.
    """
    deformed = transport_covariance(covars, deformation_gradients.index_select(1, unit_of_kernel))
    away = torch.nn.functional.normalize(positions[:, None] - centers[:, None], dim=-1)
    turned = away.transpose(1, 2) @ rotations.index_select(1, unit_of_kernel)  # rows d^T Q, (B, n, V, 3)
    basis = spherical_harmonics_basis(round(sh.shape[1] ** 0.5) - 1, turned)
    return deformed, (torch.einsum("bnvs,nsc->bvnc", basis, sh) + 0.5).clamp_min(0.0)


@torch.no_grad()
def draw_still(renderer: Renderer, scene: GaussianScene, cameras: Cameras, **options: Any) -> Rendered:
    """Draws a scene as it stands (B = 1), without loss gradients; the options are those of :func:`draw`."""
    means = scene.means
    identity, units = torch.eye(3).to(means)[None, None], torch.zeros(scene.count, dtype=torch.long).to(means.device)
    return draw(renderer, scene, means[None], identity, identity, units, cameras, **options)


@torch.no_grad()
def film(
    renderer: Renderer,
    scene: GaussianScene | SceneAppearance,
    trajectory: Trajectory,
    cameras: Cameras,
    *,
    mask: Bool[Tensor, " K"] | None = None,
    background: Float[Tensor, " 3"] | None = None,
) -> UInt8[Tensor, "F V H W 3"]:
    """All frames of a trajectory, a few at a time, without loss gradients."""
    look, parts = SceneAppearance.of(scene, mask) if isinstance(scene, GaussianScene) else scene, []
    for start in range(0, trajectory.frames, AT_A_TIME):
        now = trajectory.part(slice(start, start + AT_A_TIME))
        state = now.positions, now.deformation_gradients, now.rotations, trajectory.unit_of_kernel
        parts.append(to_bytes(draw(renderer, look, *state, cameras, background=background).rgb))
    return torch.cat(parts)


def to_bytes(image: Float[Tensor, "*shape"]) -> Tensor:
    """Rounds colours in 0..1 to uint8, clamping what lies outside."""
    return (image.clamp(0.0, 1.0) * 255 + 0.5).to(torch.uint8)
