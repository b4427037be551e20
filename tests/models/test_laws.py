"""Nonlinear forces of springs and of finite strain against their energies."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.bodies import pull_of
from torch import Tensor

from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.grid import FIRST, SECOND
from gausim.models.template.springs import Springs
from gausim.ops.rotation import quaternion_to_matrix

UNITS, MODES = 7, 5
EYE = torch.eye(3, dtype=torch.float64)
DRAW = np.random.default_rng(0)
CELLS = FiniteStrain(DRAW.normal(size=(UNITS, 9, MODES)), DRAW.random(UNITS)).double()
ENDS = np.array([[0, 0, 1, 2, 2, 3, 4, 5, 1, 0], [1, 2, 3, 3, 4, 5, 6, 6, 6, 5]])
REST, PHI = DRAW.normal(size=(UNITS, 3)), DRAW.normal(size=(UNITS, 3, MODES))
SPRINGS = Springs(ENDS, REST, PHI, DRAW.random(ENDS.shape[1]) + 0.5).double()
LAWS = pytest.mark.parametrize("law", [CELLS, SPRINGS], ids=["cells", "springs"])


def _factor(law: Any) -> Tensor:
    shape = (UNITS, 2) if law is CELLS else (ENDS.shape[1],)
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5


def _states(size: float) -> Tensor:
    return size * torch.randn(2, 3, MODES, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def _even_strain(slope: Tensor) -> Tensor:
    """A displacement gradient (3, 3) of the reference that is the same at all units."""
    return slope.flatten().expand(1, UNITS, 9)


def test_the_energy_of_cells_is_that_of_saint_venant_and_kirchhoff_beyond_the_linear() -> None:
    z, factor = _states(0.2)[0], _factor(CELLS)
    state, expected = CELLS.strain_state(z), torch.zeros(3, dtype=torch.float64)
    for s in range(3):
        for n in range(UNITS):
            h = (CELLS.gradients.view(UNITS, 9, MODES)[n] @ z[s]).view(3, 3)
            green = ((EYE + h).mT @ (EYE + h) - EYE) / 2
            for strain, sign in ((green, 1), ((h + h.mT) / 2, -1)):
                shear, bulk = 2 * SECOND * factor[n, 0], FIRST * factor[n, 1]
                twice = shear * strain.square().sum() + bulk * strain.trace() ** 2
                expected[s] += sign * CELLS.volume[n] * twice / 2
    torch.testing.assert_close(CELLS.potential(state, factor), expected)


def _spring_energies(z: Tensor, slope: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """Whole and linear energy (S,) of springs, spring by spring; ``slope`` (N, 3, 3) strains the reference."""
    mean = (torch.zeros(UNITS, 3, 3, dtype=torch.float64) + slope)[ENDS].mean(0)
    found = torch.zeros(2, len(z), dtype=torch.float64)
    for e, k in enumerate(_factor(SPRINGS) * SPRINGS.stiffness):
        i, j = ENDS[:, e]
        offset, change = (torch.from_numpy(x[j] - x[i]).float().double() for x in (REST, PHI))
        change = mean[e] @ offset + z @ change.mT
        length = offset.norm()
        squares = ((offset + change).norm(dim=-1) - length) ** 2, (change @ offset / length) ** 2
        found = found + 0.5 * k * torch.stack(squares)
    return found[0], found[1]


def test_the_energy_of_springs_is_that_of_their_lengths_beyond_the_linear() -> None:
    z = _states(0.2)[0]
    whole, linear = _spring_energies(z)
    torch.testing.assert_close(SPRINGS.potential(SPRINGS.strain_state(z), _factor(SPRINGS)), whole - linear)


def test_springs_start_from_the_lengths_of_a_strained_reference() -> None:
    """With D the displacement gradient of the reference at the units, a spring is d_0 + D d_0 + Psi z."""
    slope = 0.1 * torch.randn(UNITS, 3, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    factor, strain = _factor(SPRINGS), slope.view(1, UNITS, 9)
    for z in (_states(0.2)[0, :1].requires_grad_(), torch.zeros(1, MODES, dtype=torch.float64, requires_grad=True)):
        whole, linear = (torch.autograd.grad(e.sum(), z, retain_graph=True)[0] for e in _spring_energies(z, slope))
        torch.testing.assert_close(pull_of(SPRINGS, z.detach(), factor, strain), linear - whole)
    torch.testing.assert_close(SPRINGS.pull(strain, factor), -linear)


@LAWS
def test_the_force_is_the_slope_of_the_potential_and_of_second_order(law: Any) -> None:
    z, factor = _states(0.2)[0].requires_grad_(), _factor(law)
    (slope,) = torch.autograd.grad(law.potential(law.strain_state(z), factor).sum(), z)
    torch.testing.assert_close(pull_of(law, z, factor), -slope)
    small, large = (pull_of(law, size * z.detach(), factor).norm() for size in (1e-4, 1e-3))
    assert float(small / large) == pytest.approx(0.01, rel=0.1) and not pull_of(law, 0 * z, factor).any()


@LAWS
@pytest.mark.parametrize("damping", [0.0, 0.3])
@torch.no_grad()
def test_the_work_of_the_mean_force_is_what_the_energy_loses(law: Any, damping: float) -> None:
    (z, other), factor = _states(0.3), _factor(law)
    first, second = law.strain_state(z), law.strain_state(other)
    work = (law.between(first, second, factor, damping) * (other - z)).sum(-1)
    lost = law.potential(first, factor) - law.potential(second, factor)
    torch.testing.assert_close(work, lost - law.dissipated(first, second, factor, damping))
    assert bool((law.dissipated(first, second, factor, 0.3) > 0).all())


@LAWS
@pytest.mark.parametrize("damping", [0.0, 0.2])
@torch.no_grad()
def test_the_stiffness_of_what_is_taut_is_the_slope_of_the_force(law: Any, damping: float) -> None:
    reference, factor = law.reference_strain(_even_strain(0.3 * EYE)), _factor(law)
    z, other = _states(0.005)[:, :1]
    first = law.strain_state(z, reference)

    def force(q: Tensor) -> Tensor:
        return law.between(first, law.strain_state(q[None], reference), factor, damping)[0]

    found = law.stiffening(first, law.strain_state(other, reference), factor, damping)[0]
    torch.testing.assert_close(found, -2 * torch.func.jacrev(force)(other[0]))
    assert float(torch.linalg.eigvalsh(law.stiffening(first, first, factor)[0])[0]) > 0


@LAWS
@torch.no_grad()
def test_what_is_compressed_counts_as_stiffer_than_it_is(law: Any) -> None:
    """As if it were as long as its rest length, or under a tension that balances the pressure: it does not buckle."""
    z, factor = _states(0.3)[0, 0], _factor(law)
    ends = [law.strain_state(z[None])] * 2
    own = -torch.func.jacrev(lambda q: pull_of(law, q[None], factor)[0])(z)
    least = torch.linalg.eigvalsh(law.stiffening(*ends, factor)[0] - own)
    assert least.min() > -1e-9 * least.max() and least.max() > 0
    rest = [law.strain_state(torch.zeros(1, MODES, dtype=torch.float64))] * 2
    assert not law.stiffening(*rest, factor).abs().max() > 1e-6


@torch.no_grad()
def test_compressed_matter_does_not_make_the_stiffness_indefinite() -> None:
    factor, strain = _factor(CELLS), CELLS.gradients.view(UNITS, 3, 3, MODES)
    strain = (strain + strain.transpose(1, 2)) / 2
    weights = CELLS.volume[:, None] * factor
    linear = 2 * SECOND * torch.einsum("n,nabl,nabm->lm", weights[:, 0], strain, strain)
    trace = strain.diagonal(dim1=1, dim2=2).sum(-1)
    linear = linear + FIRST * torch.einsum("n,nl,nm->lm", weights[:, 1], trace, trace)
    ends = [CELLS.strain_state(_states(0.3)[0])] * 2
    assert float(torch.linalg.eigvalsh(linear + CELLS.stiffening(*ends, factor)).min()) > -1e-9


@torch.no_grad()
def test_a_rotation_strains_nothing() -> None:
    turned = _even_strain(quaternion_to_matrix(torch.tensor([0.9, 0.1, -0.3, 0.3], dtype=torch.float64)) - EYE)
    still, factor = torch.zeros(1, MODES, dtype=torch.float64), _factor(SPRINGS)
    assert float(CELLS.strain_state(still, CELLS.reference_strain(turned)).strain.abs().max()) < 1e-7
    linear = SPRINGS.pull(turned, factor)
    assert float((pull_of(SPRINGS, still, factor, turned) + linear).norm()) < 1e-5 * float(linear.norm())
