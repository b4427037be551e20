"""Forces of finite strain: what a solid body's stresses pull beyond those of small displacements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.kernels.operations import operation
from gausim.models.template.grid import FIRST, SECOND


def lame(factor: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
    """2 mu s and lambda b, s and b the ``factor`` on stiffness of shear and of volume."""
    shear, bulk = factor.unbind(-1)
    return torch.stack((2 * SECOND * shear, FIRST * bulk), -1)


def stress(strain: Float[Tensor, "*S N 3 3"], moduli: Float[Tensor, "N 2"]) -> Float[Tensor, "*S N 3 3"]:
    """Hooke's law of strains E, 2 mu E + lambda tr(E) I, with the ``moduli`` 2 mu and lambda."""
    double, first = moduli.unbind(-1)
    pressure = first * strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    one = torch.eye(3, dtype=strain.dtype, device=strain.device)
    return double[:, None, None] * strain + pressure[..., None, None] * one


@dataclass(frozen=True, eq=False)
class Strained:
    """The body in a state."""

    gradient: Float[Tensor, "S N 3 3"]  # of the displacement, H

    @cached_property
    def strain(self) -> Float[Tensor, "S N 3 3"]:
        """Green's strain E = (H + H^T + H^T H) / 2."""
        return (self.gradient + self.gradient.mT + self.gradient.mT @ self.gradient) / 2


@operation("gausim.kernels.elastic:strain_pull")
def strain_pull(
    first: Float[Tensor, "S N 3 3"],
    second: Float[Tensor, "S N 3 3"],
    moduli: Float[Tensor, "N 2"],
    damping: Tensor | float,
) -> Float[Tensor, "S N 3 3"]:
    """S + H S - sigma(sym H) with the means H and S of both displacement gradients and stresses.

    ``moduli`` are 2 mu and lambda times volume; ``damping`` times the growth of strain adds to the mean strain.
    """
    before, after, mean = Strained(first).strain, Strained(second).strain, (first + second) / 2
    whole = stress((before + after) / 2 + damping * (after - before), moduli)
    return whole + mean @ whole - stress((mean + mean.mT) / 2, moduli)


class FiniteStrain(nn.Module):
    """Nonlinear forces of a solid under large rotations and strains, in modal coordinates.

    Of every unit the cells near it have the energy w sigma(E) : E / 2 with Green's strain E and Hooke's law
    sigma(E) = 2 mu s E + lambda b tr(E) I (Saint Venant and Kirchhoff), linearised w sigma(eps) : eps / 2 with the
    small strain eps = (H + H^T) / 2. The force is minus the derivative of their difference, so it has a potential and
    is of second order in z; the linear part is in the matrices. Rotations, of which E knows nothing, cost no energy. s
    and b are the unit's ``factor``. Where the reference of the modes is itself strained, by S, H = S + sum_m H_m z_m.
    """

    gradients: Tensor  # H_m, displacement gradients of the modes near the units, row by row (9 N, M) [1 / scene units]
    volume: Tensor  # w of the cells near each unit (N,)
    measures: Tensor  # derivatives of the seven measures of sym(F^T H) with respect to F and H (9, 7 x 9)
    linear: Tensor  # products of what the measures at rest are of H (7, 81)
    moduli: Tensor  # of shear and of volume in the energy of each measure (2, 7)

    def __init__(self, gradients: np.ndarray, volume: np.ndarray, *, scale: float = 1.0) -> None:
        """Takes displacement gradients (N, 9, M) of the modes and volumes (N,), in multiples of 1 / ``scale``."""
        super().__init__()
        for name, array in {"gradients": gradients.reshape(-1, gradients.shape[-1]), "volume": scale * volume}.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)).float(), persistent=False)
        moduli = torch.tensor([6 * [2 * SECOND] + [0.0], 6 * [0.0] + [FIRST]])
        self.register_buffer("measures", _measures(), persistent=False)
        rest = (torch.eye(3).flatten() @ self.measures).unflatten(-1, (7, 9))
        self.register_buffer("linear", (rest[:, :, None] * rest[:, None]).flatten(1), persistent=False)
        self.register_buffer("moduli", moduli, persistent=False)

    def reference_strain(self, strain: Float[Tensor, "S N 9"]) -> Float[Tensor, "S N 3 3"]:
        """S of every unit."""
        return strain.unflatten(-1, (3, 3))

    def strain_state(self, z: Float[Tensor, "S M"], reference: Float[Tensor, "S N 3 3"] | None = None) -> Strained:
        """The body in a state of the modes; ``reference`` is that of :meth:`reference_strain`."""
        gradient = (z @ self.gradients.mT).unflatten(-1, (-1, 3, 3))
        gradient = gradient if reference is None else gradient + reference
        return Strained(gradient)

    def between(
        self, first: Strained, second: Strained, factor: Float[Tensor, "N 2"], damping: Tensor | float = 0.0
    ) -> Float[Tensor, "S M"]:
        """Mean nonlinear force from one state to another, whose work is the loss of :meth:`potential` and damping.

        The mean of both stresses acts on the mean of both deformations (Simo and Tarnow 1992), and more by ``damping``
        times the growth of strain (Armero and Romero 2001), which no rotation changes.
        """
        moduli = lame(self.volume[:, None] * factor)
        return -(strain_pull(first.gradient, second.gradient, moduli, damping).flatten(1) @ self.gradients)

    def stiffening(
        self, first: Strained, second: Strained, factor: Float[Tensor, "N 2"], damping: Tensor | float = 0.0,
        *, buckling: bool = False,
    ) -> Float[Tensor, "S M M"]:  # fmt: skip
        """Twice the negative derivative of :meth:`between` with respect to z of the second state.

        With the mean F and S of both deformation gradients and stresses, F_2 of the second state and a motion H, that
        is H S + (1 + 2 damping) F sigma(sym(F_2^T H)) - sigma(sym H). Compressed matter buckles; S is then made
        positive semi-definite by an isotropic tension, so that with the linear stiffness this is, too. With
        ``buckling`` it is not, and the derivative is exact.
        """
        one = torch.eye(3, dtype=self.gradients.dtype, device=self.gradients.device)
        gradient, stress = self._means(first, second, factor, damping)
        if not buckling:
            own = stress.diagonal(dim1=-2, dim2=-1)
            least = (own - (stress.abs().sum(-1) - own.abs())).amin(-1)  # Gershgorin's bound of the eigenvalues
            stress = stress + (-least).clamp_min(0)[..., None, None] * one
        weight = ((self.volume[:, None] * factor) @ self.moduli)[..., None]
        mean, last = (
            (f.flatten(-2) @ self.measures).unflatten(-1, (7, 9)) for f in (gradient + one, second.gradient + one)
        )
        # Blocks (9, 9) of every unit, by rows and columns of what is pulled and of what moves.
        blocks = (1 + 2 * damping) * mean.mT @ (weight * last) - (weight.mT @ self.linear).unflatten(-1, (9, 9))[:, 0]
        blocks.unflatten(-1, (3, 3)).unflatten(-3, (3, 3)).diagonal(dim1=-4, dim2=-2).add_(stress[..., None])
        turned = blocks @ self.gradients.unflatten(0, (-1, 9))
        return self.gradients.mT @ turned.flatten(-3, -2)

    def potential(self, state: Strained, factor: Float[Tensor, "N 2"]) -> Float[Tensor, " S"]:
        """Potential energy of the nonlinear force."""
        small = (state.gradient + state.gradient.mT) / 2
        energies = (self._stress(e, factor) * e for e in (state.strain, small))
        whole, linear = (0.5 * energy.flatten(1).sum(-1) for energy in energies)
        return whole - linear

    def dissipated(
        self, first: Strained, second: Strained, factor: Float[Tensor, "N 2"], damping: Tensor | float
    ) -> Float[Tensor, " S"]:
        """Energy that ``damping`` takes from one state to another."""
        grown = second.strain - first.strain
        return damping * (self._stress(grown, factor) * grown).flatten(1).sum(-1)

    def _means(
        self, first: Strained, second: Strained, factor: Tensor, damping: Tensor | float
    ) -> tuple[Float[Tensor, "S N 3 3"], Float[Tensor, "S N 3 3"]]:
        """Mean displacement gradient and mean stress times volume."""
        strain = (first.strain + second.strain) / 2 + damping * (second.strain - first.strain)
        return (first.gradient + second.gradient) / 2, self._stress(strain, factor)

    def _stress(self, strain: Float[Tensor, "*S N 3 3"], factor: Float[Tensor, "N 2"]) -> Float[Tensor, "*S N 3 3"]:
        """Hooke's stress of a strain, times volume."""
        return stress(strain, lame(self.volume[:, None] * factor))


def _measures() -> Float[Tensor, "9 63"]:
    """Three strains, three shear strains times the root of 2, and the trace: the energy is a sum of their squares.

    By rows F_ij, by columns measure and H_kl.
    """
    maps = torch.zeros(3, 3, 7, 3, 3)
    for number, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))):
        for k in range(3):
            for first, second in ((i, j), (j, i)):
                maps[k, first, number, k, second] += 0.5 if i == j else 0.5**0.5
    maps[:, :, 6] = maps[:, :, :3].sum(2)
    return maps.flatten(2).flatten(0, 1)
