"""Forces of finite strain against their energy, and modal derivatives against a body that bends far."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.bodies import pull_of

from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.grid import FIRST, SECOND
from gausim.models.template.solid import SolidBody, solid_body
from gausim.ops.quaternion import quaternion_to_matrix


@pytest.fixture(scope="module")
def cells() -> FiniteStrain:
    """Seven units and five modes, double precision."""
    draw = np.random.default_rng(0)
    return FiniteStrain(draw.normal(size=(7, 9, 5)), draw.random(7)).double()


FACTOR = torch.rand(7, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5


def _states(size: float) -> torch.Tensor:
    return size * torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_the_energy_is_that_of_saint_venant_and_kirchhoff_beyond_the_linear(cells: FiniteStrain) -> None:
    z = _states(0.2)[0]
    state, expected = cells.stretched(z), torch.zeros(3, dtype=torch.float64)
    for s in range(3):
        for n in range(7):
            h = (cells.gradients.view(7, 9, 5)[n] @ z[s]).view(3, 3)
            green = ((torch.eye(3) + h).mT @ (torch.eye(3) + h) - torch.eye(3)) / 2
            for strain, sign in ((green, 1), ((h + h.mT) / 2, -1)):
                shear, bulk = 2 * SECOND * FACTOR[n, 0], FIRST * FACTOR[n, 1]
                twice = shear * strain.square().sum() + bulk * strain.trace() ** 2
                expected[s] += sign * cells.volume[n] * twice / 2
    torch.testing.assert_close(cells.potential(state, FACTOR), expected)


def test_the_force_is_the_gradient_of_the_potential_and_of_second_order(cells: FiniteStrain) -> None:
    z = _states(0.2)[0].requires_grad_()
    (slope,) = torch.autograd.grad(cells.potential(cells.stretched(z), FACTOR).sum(), z)
    torch.testing.assert_close(pull_of(cells, z, FACTOR), -slope)
    small, large = (pull_of(cells, size * z.detach(), FACTOR).norm() for size in (1e-4, 1e-3))
    assert float(small / large) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("damping", [0.0, 0.3])
@torch.no_grad()
def test_the_work_of_the_mean_force_is_what_the_energy_loses(cells: FiniteStrain, damping: float) -> None:
    z, other = _states(0.3)
    first, second = cells.stretched(z), cells.stretched(other)
    work = (cells.between(first, second, FACTOR, damping) * (other - z)).sum(-1)
    lost = cells.potential(first, FACTOR) - cells.potential(second, FACTOR)
    torch.testing.assert_close(work, lost - cells.dissipated(first, second, FACTOR, damping))
    assert bool((cells.dissipated(first, second, FACTOR, 0.3) > 0).all())


@pytest.mark.parametrize("damping", [0.0, 0.2])
@torch.no_grad()
def test_the_stiffness_of_what_is_taut_is_the_slope_of_the_force(cells: FiniteStrain, damping: float) -> None:
    taut = cells.strained((0.3 * torch.eye(3, dtype=torch.float64)).flatten().expand(1, 7, 9))
    z, other = _states(0.005)[:, :1]
    first = cells.stretched(z, taut)

    def force(q: torch.Tensor) -> torch.Tensor:
        return cells.between(first, cells.stretched(q[None], taut), FACTOR, damping)[0]

    found = cells.stiffening(first, cells.stretched(other, taut), FACTOR, damping)[0]
    torch.testing.assert_close(found, -2 * torch.func.jacrev(force)(other[0]))
    assert float(torch.linalg.eigvalsh(cells.stiffening(first, first, FACTOR)[0])[0]) > 0


@torch.no_grad()
def test_compressed_matter_does_not_make_the_stiffness_indefinite(cells: FiniteStrain) -> None:
    ends = [cells.stretched(_states(0.3)[0])] * 2
    rest = [cells.stretched(torch.zeros(1, 5, dtype=torch.float64))] * 2
    assert not cells.stiffening(*rest, FACTOR).abs().max() > 1e-12
    strain = cells.gradients.view(7, 3, 3, 5)
    strain = (strain + strain.transpose(1, 2)) / 2
    weights = cells.volume[:, None] * FACTOR
    linear = 2 * SECOND * torch.einsum("n,nabl,nabm->lm", weights[:, 0], strain, strain)
    trace = strain.diagonal(dim1=1, dim2=2).sum(-1)
    linear = linear + FIRST * torch.einsum("n,nl,nm->lm", weights[:, 1], trace, trace)
    assert float(torch.linalg.eigvalsh(linear + cells.stiffening(*ends, FACTOR)).min()) > -1e-9


@torch.no_grad()
def test_a_rotation_strains_nothing(cells: FiniteStrain) -> None:
    turn = quaternion_to_matrix(torch.tensor([0.9, 0.1, -0.3, 0.3], dtype=torch.float64))
    turned = cells.strained((turn - torch.eye(3)).flatten().expand(1, 7, 9))
    assert float(cells.stretched(torch.zeros(1, 5, dtype=torch.float64), turned).strain.abs().max()) < 1e-7


def _clamped(curved: int) -> tuple[SolidBody, np.ndarray]:
    """A slender bar held at one end, and its kernels (K, 3)."""
    axes = [np.linspace(0, s, round(s / 0.125) + 1) for s in (4.0, 0.5, 0.5)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    kernels = points[((points == 0) | (points == np.array([4.0, 0.5, 0.5]))).any(1)]
    pinned = kernels[:, 0] == 0
    body = solid_body(kernels, pinned, kernels, np.ones(len(kernels)), pinned, modes=16, spacing=0.25, curved=curved)
    return body, kernels


def test_vibrations_come_before_modal_derivatives() -> None:
    (plain, kernels), (curved, _) = _clamped(0), _clamped(4)
    count = curved.vibrations
    assert plain.vibrations == 16 and count == 8 and len(curved.values) == 16
    np.testing.assert_allclose(curved.values[:count], plain.values[:count], rtol=1e-6)
    assert curved.values[count:].min() > plain.values[count]
    first, second = (body.at(kernels)[0][..., :count].reshape(-1, count) for body in (plain, curved))
    # The square bar bends alike in two directions, so spans are compared and not single modes.
    np.testing.assert_allclose(first @ np.linalg.lstsq(first, second, rcond=None)[0], second, atol=1e-6)


def test_modal_derivatives_let_a_bar_bend_far_at_the_cost_of_bending() -> None:
    """Linear modes lengthen a bar that bends, and then it is stiff; with derivatives the tip comes nearer instead."""
    worst, grown = {}, {}
    for curved in (0, 4):
        body, kernels = _clamped(curved)
        cells = FiniteStrain(*body.mean_gradients(kernels)).double()
        values, tip = torch.from_numpy(body.values), torch.from_numpy(body.at(np.array([[4.0, 0.25, 0.25]]))[0][0])
        factor = torch.ones(len(cells.volume), 2, dtype=torch.float64)
        bent = torch.zeros_like(values)
        bent[0] = 1.0 / float(tip[:, 0].norm())  # a quarter of the length
        z = bent.clone().requires_grad_()
        free = torch.ones_like(values)
        free[0] = 0
        search = torch.optim.LBFGS([z], max_iter=400, line_search_fn="strong_wolfe", tolerance_grad=1e-12)

        def energy(z=z, values=values, cells=cells, factor=factor, bent=bent, free=free):
            q = bent + free * z
            return 0.5 * (values * q.square()).sum() + cells.potential(cells.stretched(q[None]), factor)[0]

        def closure(energy=energy, search=search, z=z):
            search.zero_grad()
            found = energy()
            found.backward()
            return found

        search.step(closure)
        worst[curved] = float(energy().detach() / (0.5 * values[0] * bent[0] ** 2))
        grown[curved] = float((tip @ (bent + free * z.detach()))[0])
    assert worst[0] > 2 and worst[4] < 1.3
    # An elastic cantilever's tip comes nearer by 3/5 of the squared deflection over its length.
    assert grown[4] == pytest.approx(-0.6 * 1.0 / 4, rel=0.15)
