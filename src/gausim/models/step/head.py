"""Heads: the map from the network's output to a deformation gradient."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.ops.deformation import deformation_gradient_from_output

# Levers shorter than this shift by less than the output: a deformation about the parent cannot move a unit that
# coincides with it [diagonals].
SHORT = 0.03
# Floor of a lever's length [diagonals].
TINY = 1e-4
# Floor of a lever's stretch along itself, as it enters the stretch across it.
MIN_ALONG = 0.2


OUTPUTS = 11  # two quaternions and three logarithms of stretches
LEVER_OUTPUTS = 3


@dataclass(frozen=True)
class Head:
    """Map from the network's output to deformation gradients.

    Attributes:
        output_scale: factor on the eleven outputs of F.
        zero_output: initialise the network to zero output (F = I).
        lever: scale [diagonals per unit of output] of three more outputs, which shift a unit's lever
            (:func:`lever_deformation`); 0: no such outputs.
        anchor: subtract the network's outputs at rest, so that rest is an equilibrium.
    """

    output_scale: float = 0.1
    zero_output: bool = True
    lever: float = 0.02
    anchor: bool = True

    @property
    def outputs(self) -> int:
        """Number of network outputs per unit."""
        return OUTPUTS + (LEVER_OUTPUTS if self.lever else 0)

    def __call__(
        self,
        output: Float[Tensor, "N O"],
        lever: Float[Tensor, "N 3"] | None,
        length: Float[Tensor, "N 1"],
        *,
        conserve_mass: bool,
    ) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3 3"]]:
        """F = U diag(lambda) V^T, followed by the deformation of the lever, and the rotation U V^T.

        ``lever`` is that of :func:`lever_deformation`, None without a lever head.
        """
        deformation_gradient, rotation = deformation_gradient_from_output(
            output[:, :OUTPUTS] * self.output_scale, conserve_mass=conserve_mass
        )
        if lever is None:
            return deformation_gradient, rotation
        shift = output[:, OUTPUTS:] * (self.lever * length)
        return lever_deformation(shift, lever, length, conserve_mass=conserve_mass) @ deformation_gradient, rotation


def lever_deformation(
    shift: Float[Tensor, "N 3"], lever: Float[Tensor, "N 3"], length: Float[Tensor, "N 1"], *, conserve_mass: bool
) -> Float[Tensor, "N 3 3"]:
    """The deformation gradient that maps the lever w from the parent to w + s; zero shift gives the identity.

    F = (w + s) w^T / |w|^2 + d (I - w w^T / |w|^2) with d = (1 + s.w / |w|^2)^(-1/2), so that det F = 1; d = 1 without
    mass conservation. The unit's translation is linear in s; without it, it would take a rotation about the parent.

    Args:
        shift: s [scene units]; it is scaled by |w|^2 / (|w|^2 + (SHORT length)^2).
        lever: w = x_i - x_p before F acts [scene units].
        length: diagonal of each unit's scene [scene units].
        conserve_mass: whether det F = 1.
    """
    square = lever.square().sum(-1, keepdim=True)
    shift = shift * (square / (square + (SHORT * length).square()))
    square = square + (TINY * length).square()
    along = lever[:, :, None] * lever[:, None, :] / square[:, :, None]
    identity = torch.eye(3, dtype=lever.dtype, device=lever.device)
    across = identity - along
    if conserve_mass:
        stretch = (1 + (shift * lever).sum(-1, keepdim=True) / square).clamp_min(MIN_ALONG)
        across = across * stretch.rsqrt()[:, :, None]
    return along + shift[:, :, None] * lever[:, None, :] / square[:, :, None] + across
