"""Trained factors on the decoded matrices of one scene."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

# Gain of the mixing of modes over the logarithms: with one learning rate these change faster.
MIXING_GAIN = 0.3


class OwnMatrices(nn.Module):
    """Factors on decoded stiffness K_0, mass M_0 and damping D_0 of one scene, so that its modes may mix.

    With L = chol K_0, C = chol D_0, trained matrices W, W', W'' and trained vectors k, d, all zero at the start,

        K = H^T L (I + 0.3 W) e^{2k} (I + 0.3 W)^T L^T H
        D = H^T C (I + 0.3 W') e^{2d} (I + 0.3 W')^T C^T H
        M = H^T M_0 H,  H = I + 0.3 W''

    At zero these are K_0, D_0 and M_0; whatever is trained, all three are positive semi-definite.
    """

    def __init__(self, modes: int) -> None:
        """Builds the parameters of a scene of so many modes."""
        super().__init__()
        self.stiffness = nn.Parameter(torch.zeros(modes))
        self.damping = nn.Parameter(torch.zeros(modes))
        self.stiffness_mixing = nn.Parameter(torch.zeros(modes, modes))
        self.damping_mixing = nn.Parameter(torch.zeros(modes, modes))
        self.inertia_mixing = nn.Parameter(torch.zeros(modes, modes))

    def forward(
        self, stiffness: Float[Tensor, "M M"], mass: Float[Tensor, "M M"], damping: Float[Tensor, "M M"]
    ) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M M"], Float[Tensor, "M M"]]:
        """K, M and D of K_0, M_0 and D_0, which are positive definite."""
        inertia_root = _mixed(self.inertia_mixing)
        roots = [
            inertia_root.mT @ torch.linalg.cholesky_ex(matrix)[0] @ _mixed(mixing) * log.exp()
            for matrix, mixing, log in (
                (stiffness, self.stiffness_mixing, self.stiffness),
                (damping, self.damping_mixing, self.damping),
            )
        ]
        return roots[0] @ roots[0].mT, inertia_root.mT @ mass @ inertia_root, roots[1] @ roots[1].mT

    def mixing_size(self) -> Float[Tensor, ""]:
        """Squared Frobenius norm of the mode mixing in stiffness, damping and inertia."""
        mixings = (self.stiffness_mixing, self.damping_mixing, self.inertia_mixing)
        return torch.stack([(MIXING_GAIN * m).square().sum() for m in mixings]).sum()


def _mixed(mixing: Float[Tensor, "M M"]) -> Float[Tensor, "M M"]:
    return torch.eye(len(mixing), dtype=mixing.dtype, device=mixing.device) + MIXING_GAIN * mixing
