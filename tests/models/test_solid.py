"""Modes of the solid body: splines, energies and inertia against closed forms, modes against theory of bars."""

from functools import cache

import numpy as np
import pytest
import torch

from gausim.models.template import grid as grids
from gausim.models.template import solid
from gausim.models.template.finite_strain import FiniteStrain


def _shell(size: tuple[float, float, float], step: float) -> np.ndarray:
    """Points on the faces of a box."""
    axes = [np.linspace(0, s, round(s / step) + 1) for s in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points[((points == 0) | (points == np.array(size))).any(1)]


@pytest.fixture
def grid() -> grids.Grid:
    return grids.Grid(np.array([-1.0, 0.5, 2.0]), 0.25, (9, 10, 11))


def test_splines_reproduce_linear_fields_and_their_gradients(grid: grids.Grid) -> None:
    rng = np.random.default_rng(0)
    points = grid.origin + 0.25 * rng.uniform(2, 6, (50, 3))
    nodes, weights, gradients = grid.splines(points)
    centres = grid.origin + 0.25 * np.stack(np.unravel_index(np.arange(grid.size), grid.shape), -1)
    slope = rng.normal(size=(3, 2))
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(gradients.sum(1), 0, atol=1e-11)
    field = centres @ slope
    np.testing.assert_allclose(np.einsum("pk,pkc->pc", weights, field[nodes]), points @ slope, atol=1e-11)
    found = np.einsum("pkb,pkc->pbc", gradients, field[nodes])
    np.testing.assert_allclose(found, np.broadcast_to(slope, found.shape), atol=1e-11)


def test_cells_are_closed_without_holes_and_do_not_depend_on_rounding() -> None:
    shell = np.ones((9, 9, 9), dtype=bool)
    shell[1:-1, 1:-1, 1:-1] = False
    assert grids.inside(shell).all()
    sheet = np.zeros((9, 9, 9), dtype=bool)
    sheet[:, :, 4] = True
    np.testing.assert_array_equal(grids.inside(sheet), sheet)
    # The volume of a cube is that of its solid cells; fine ones between its kernels are empty.
    rng = np.random.default_rng(0)
    points, face = rng.uniform(size=(300, 3)), rng.integers(0, 6, 300)
    points[np.arange(300), face // 2] = face % 2
    diagonal, volumes = 3**0.5, {}
    for least in (0.0, 1.7):
        _, _, weights = grids.cells(points, solid.SolidSettings(0.05, least).size(points, diagonal))
        volumes[least] = weights[weights == weights.max()].sum()
    assert volumes[0.0] < 0.5 and volumes[1.7] == pytest.approx(1.0, abs=0.2)
    assert solid.SolidSettings(0.2, 1.7).size(points, diagonal) == pytest.approx(0.2 * diagonal)
    points = np.random.default_rng(0).random((60, 3))
    _, centres, weights = grids.cells(points, 0.3)
    for shift in np.linspace(0.1, 7.7, 20):  # the outermost points lie on borders of cells
        _, moved, same = grids.cells(points + shift, 0.3)
        assert np.array_equal(weights, same)
        np.testing.assert_allclose(moved - shift, centres, atol=1e-12)


def test_energy_of_a_uniform_strain_is_that_of_hooke() -> None:
    points = _shell((1.0, 0.8, 0.6), 0.1)
    grid, centres, weights = grids.cells(points, 0.2)
    blocks = grids.stiffness(grid, centres, weights)
    nodes = grid.origin + grid.spacing * np.stack(np.unravel_index(np.arange(grid.size), grid.shape), -1)
    slope = np.random.default_rng(1).normal(size=(3, 3))
    field = nodes @ slope.T
    energy = sum(field[:, a] @ (blocks[a][b] @ field[:, b]) for a in range(3) for b in range(3)) / 2
    strain, nu = (slope + slope.T) / 2, grids.POISSON
    first, second = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
    expected = (first / 2 * np.trace(strain) ** 2 + second * (strain**2).sum()) * weights.sum()
    assert energy == pytest.approx(expected, rel=1e-9)
    turn = nodes @ (slope - slope.T)
    still = sum(turn[:, a] @ (blocks[a][b] @ turn[:, b]) for a in range(3) for b in range(3))
    assert abs(still) < 1e-9 * abs(energy)


@cache
def _bar(spacing: float = 0.25, modes: int = 40):
    """A bar of 4 x 1 x 1 held at one end, known by its faces only; its units are points on its axis and around it."""
    kernels = _shell((3.875, 0.875, 0.875), 0.125)  # each stands for the cell of 0.125 that begins there
    axes = np.concatenate(([0], np.arange(16) / 4 + 0.125)), [0.1, 0.5, 0.9], [0.1, 0.5, 0.9]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    rest = np.stack((x, y, z), -1).reshape(-1, 3)
    pinned, mass = rest[:, 0] == 0, np.full(len(rest), 2.0)
    found = solid.solid_body(kernels, kernels[:, 0] == 0, rest, mass, pinned, modes=modes, spacing=spacing)
    phi, slopes = found.at(rest)
    phi[pinned], slopes[pinned] = 0, 0
    return found.values / found.values[0], phi, slopes, rest, mass, pinned


def test_modes_of_a_held_bar() -> None:
    values, phi, slopes, rest, mass, pinned = _bar()
    ratio = np.sqrt(values)
    along = np.einsum("nm,n->m", phi[:, 0], mass) ** 2
    first = int(along.argmax())  # stretches without turning: cos-like, the lowest axial mode
    np.testing.assert_allclose(ratio[1], 1.0, atol=0.02)  # it bends both ways alike
    # Axial over bending: (pi / 2) / (3.516 / (4 sqrt(12))) = 6.19 for a slender bar; shear and rotation lower the
    # bending of this one by about 4 % (Timoshenko).
    assert ratio[first] == pytest.approx(6.19 * 1.04, rel=0.05)
    shape = np.sin(np.pi * rest[:, 0] / 8)
    cosine = phi[:, 0, first] @ shape / np.linalg.norm(phi[:, 0, first]) / np.linalg.norm(shape)
    assert abs(cosine) > 0.99
    lowest = phi[..., :24]
    np.testing.assert_allclose(np.einsum("nam,n,nak->mk", lowest, mass, lowest), np.eye(24), atol=2e-2)
    assert not phi[pinned].any() and not slopes[pinned].any()
    assert (np.diff(values) > -1e-9).all() and values[0] == 1
    few = _bar(spacing=0.6, modes=6)
    many = _bar(spacing=0.6, modes=110)  # more than a third of the unknowns: dense
    np.testing.assert_allclose(few[0], many[0][:6] * 1.0, rtol=1e-6)


def test_a_body_is_held_inside_of_its_pinned_surface() -> None:
    kernels = _shell((2.0, 2.0, 1.0), 0.125)
    rest = np.stack(np.meshgrid(*[np.linspace(0.1, s - 0.1, 8) for s in (2.0, 2.0, 1.0)], indexing="ij"), -1)
    rest = rest.reshape(-1, 3)
    free = np.zeros(len(rest), dtype=bool)
    body = solid.solid_body(kernels, kernels[:, 2] <= 0.5, rest, np.ones(len(rest)), free, modes=4, spacing=0.25)
    core = np.array([[1.0, 1.0, 0.125], [1.0, 1.0, 0.25]])  # no kernel within .5, pinned ones are the nearest
    assert np.abs(body.at(core)[0]).max() < 0.02 * np.abs(body.at(rest)[0]).max()


def test_gradients_of_modes_are_those_of_the_field() -> None:
    kernels = _shell((2.0, 1.0, 1.0), 0.125)
    centre = np.array([[1.1, 0.4, 0.6]])
    probes = np.concatenate([centre + s * 1e-4 * np.eye(3)[a] for a in range(3) for s in (1, -1)])
    rest = np.concatenate((centre, probes, np.random.default_rng(2).uniform(0, 1, (40, 3)) * (2, 1, 1)))
    pinned = np.zeros(len(rest), dtype=bool)
    held = kernels[:, 0] == 0
    body = solid.solid_body(kernels, held, rest, np.ones(len(rest)), pinned, modes=5, spacing=0.3)
    phi, slopes = body.at(rest)
    for axis in range(3):
        difference = (phi[1 + 2 * axis] - phi[2 + 2 * axis]) / 2e-4
        np.testing.assert_allclose(slopes[0, :, axis], difference, atol=1e-4 * np.abs(slopes[0]).max())


def test_parts_that_nothing_holds_still_have_orthonormal_modes() -> None:
    axis = np.array([0.0, 0.5, 1.0])
    kernels = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)  # each an island of its own
    held = kernels[:, 2] < 0.1
    mass = np.random.default_rng(0).uniform(0.5, 2.0, len(kernels))
    body = solid.solid_body(kernels, held, kernels, mass, held, modes=40, spacing=0.1)
    phi, slopes = body.at(kernels)
    phi[held] = 0
    gram = np.einsum("nam,n,nak->mk", phi, mass, phi)
    np.testing.assert_allclose(gram, np.eye(len(body.values)), atol=1e-5)
    assert np.isfinite(slopes).all() and len(body.values) == 40


def _clamped(curved: int) -> tuple[solid.SolidBody, np.ndarray]:
    """A slender bar held at one end, and its kernels (K, 3)."""
    kernels = _shell((4.0, 0.5, 0.5), 0.125)
    held = kernels[:, 0] == 0
    body = solid.solid_body(kernels, held, kernels, np.ones(len(kernels)), held, modes=16, spacing=0.25, curved=curved)
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
            return 0.5 * (values * q.square()).sum() + cells.potential(cells.strain_state(q[None]), factor)[0]

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
