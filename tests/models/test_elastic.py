from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import scipy.linalg
import torch

from gausim.core import SimState
from gausim.models.hierarchy.clusters import Hierarchy, build_hierarchy
from gausim.models.initial_state import ModalInitialStates
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.template.elastic import ElasticScene, ElasticTemplate
from gausim.models.template.springs import mode_gradients, spring_network, vibration_modes
from gausim.models.template.template import Motion


def _spring_block(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Stiffness 1 / length^2 along the spring and three tenths of it across."""
    length = np.linalg.norm(b - a)
    n = (b - a) / length
    return (np.outer(n, n) + 0.3 * (np.eye(3) - np.outer(n, n))) / length**2


def _dense_modes(rest: np.ndarray, mass: np.ndarray, pinned: np.ndarray, pairs: set[tuple[int, int]]):
    stiffness = np.zeros((len(rest), 3, len(rest), 3))
    for i, j in pairs:
        block = _spring_block(rest[i], rest[j])
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            stiffness[a, :, b] += sign * block
    free = np.flatnonzero(~pinned)
    k = stiffness[free][:, :, free].reshape(3 * len(free), -1)
    values, vectors = scipy.linalg.eigh(k, np.diag(np.repeat(mass[free], 3)))
    full = np.zeros((len(rest), 3, len(values)))
    full[free] = vectors.reshape(len(free), 3, -1)
    return values, full


def _same_spaces(phi: np.ndarray, reference: np.ndarray, mass: np.ndarray) -> np.ndarray:
    overlap = np.einsum("ndm,n,ndk->mk", phi, mass, reference)
    return np.linalg.svd(overlap, compute_uv=False)


def test_modes_of_a_chain_solve_the_generalised_eigenproblem() -> None:
    rng = np.random.default_rng(0)
    # Links grow, so that the nearest neighbour of every bead is the one before it: the springs are the chain.
    steps = (
        np.array([[1.0, 0.2 * math.sin(i), 0.2 * math.cos(2 * i)] for i in range(11)]) * 1.12 ** np.arange(11)[:, None]
    )
    rest = np.concatenate((np.zeros((1, 3)), np.cumsum(steps, 0)))
    mass, pinned = rng.uniform(0.5, 2.0, 12), np.arange(12) == 0
    values, phi = vibration_modes(rest, mass, pinned, modes=7, neighbours=1)
    expected, reference = _dense_modes(rest, mass, pinned, {(i, i + 1) for i in range(11)})
    np.testing.assert_allclose(values, np.maximum(expected[:7], 1e-4 * expected[6]) / expected[0], rtol=1e-9)
    np.testing.assert_allclose(np.einsum("ndm,n,ndk->mk", phi, mass, phi), np.eye(7), atol=1e-10)
    np.testing.assert_allclose(_same_spaces(phi, reference[:, :, :7], mass), np.ones(7), atol=1e-9)
    assert values[-1] > 2 * values[0] and not phi[0].any()


def test_large_networks_use_the_sparse_solver_and_agree_with_the_dense_one() -> None:
    rng = np.random.default_rng(1)
    rest, mass = rng.uniform(size=(130, 3)) * (1, 0.5, 2), rng.uniform(0.5, 2.0, 130)
    pinned = rest[:, 2] < 0.2
    assert 3 * int((~pinned).sum()) > 300
    values, phi = vibration_modes(rest, mass, pinned, modes=5, neighbours=8)
    near = np.argsort(np.linalg.norm(rest[:, None] - rest, axis=-1), 1)[:, 1:9]
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(130) for j in near[i]}
    expected, reference = _dense_modes(rest, mass, pinned, pairs)
    np.testing.assert_allclose(values, expected[:5] / expected[0], rtol=1e-6)
    np.testing.assert_allclose(_same_spaces(phi, reference[:, :, :5], mass), np.ones(5), atol=1e-6)


def test_mode_gradients_of_an_affine_motion_are_its_matrix() -> None:
    rng = np.random.default_rng(2)
    rest, matrices = rng.uniform(size=(60, 3)), rng.normal(size=(3, 3, 4))
    motion = np.einsum("ijm,nj->nim", matrices, rest) + rng.normal(size=(1, 3, 4))
    found = mode_gradients(rest, motion, 8)
    error = np.abs(found - matrices)  # the ridge shrinks gradients a little where neighbours are almost coplanar
    assert error.max() < 0.1 and np.median(error) < 0.01


def _scene(hierarchy: Hierarchy, **settings) -> ElasticScene:
    """Nine modes in double precision, linear and with mass by volume unless told otherwise."""
    own = {
        "modes": 9,
        "neighbours": 8,
        "period": 12.0,
        "hidden": 0,
        "amplitude": 0.02,
        "damping": "full",
        "inertia": "volume",
        "geometric": None,
        "solid": None,
    }
    return ElasticScene(hierarchy, 1, **own | settings).double().requires_grad_(False)


MATRICES = [(damping, "volume") for damping in ("full", "modal", "rayleigh", "structural")] + [("full", "trained")]


@pytest.fixture(params=MATRICES, ids="-".join)
def elastic(make_scene, request) -> ElasticScene:
    hierarchy = build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))
    damping, inertia = request.param
    return _scene(hierarchy, damping=damping, inertia=inertia)


def _undamped(scene: ElasticScene) -> None:
    scene.damping.fill_(-1e4)


@pytest.mark.parametrize("mode", [0, 3, 8])
def test_undamped_mode_keeps_its_amplitude_and_turns_by_two_atan_half_omega(elastic: ElasticScene, mode: int) -> None:
    _undamped(elastic)
    omega = 2 * math.pi / 12.0 * math.sqrt(float(elastic.values[mode]))
    angle = 2 * math.atan(omega / 2)
    shape = elastic.modes[None, :, :, mode]
    before, now = shape * math.cos(-angle), shape * 1.0
    peak = 0.0
    for frame in range(1, 501):
        z = elastic(now, before)[0]
        assert abs(float(z[mode]) - math.cos(angle * frame)) < 1e-3
        assert float(z[torch.arange(9) != mode].abs().max()) < 1e-3  # without mixing the modes do not talk
        before, now = now, torch.einsum("m,ndm->nd", z, elastic.modes)[None]
        peak = max(peak, abs(float(z[mode])))
    assert peak > 0.99


def test_first_mode_starts_with_the_given_period(elastic: ElasticScene) -> None:
    stiffness = _stiffness(elastic)
    assert math.sqrt(float(torch.linalg.eigvalsh(stiffness)[0])) == pytest.approx(2 * math.pi / 12.0, rel=1e-6)


def _stiffness(scene: ElasticScene) -> torch.Tensor:
    a, _, inverse = scene.matrices()
    return 2 * (2 * _inertia(scene) - torch.linalg.solve(inverse, a))


def _inertia(scene: ElasticScene) -> torch.Tensor:
    root = scene.inertia_root()
    return torch.eye(len(scene.values), dtype=torch.float64) if root is None else root.mT @ root


def _shake(scene: ElasticScene, generator: torch.Generator) -> None:
    for p in scene.parameters():
        p.copy_(torch.randn(p.shape, generator=generator, dtype=torch.float64) * (3.0 if p.ndim == 2 else 0.5))


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_discrete_energy_never_grows_for_random_mixing(elastic: ElasticScene, seed: int, damped: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    _shake(elastic, generator)
    if not damped:
        _undamped(elastic)
    stiffness, inertia = _stiffness(elastic), _inertia(elastic)
    assert float((stiffness - torch.diag(stiffness.diagonal())).abs().max()) > 0.1  # the modes do mix
    a, b, _ = elastic.matrices()
    before, now = torch.randn(2, 9, generator=generator, dtype=torch.float64)
    energies = []
    for _ in range(2000):
        velocity, middle = now - before, (now + before) / 2
        energies.append(float(velocity @ inertia @ velocity + middle @ stiffness @ middle) / 2)
        before, now = now, a @ now - b @ before
    energy = torch.tensor(energies, dtype=torch.float64)
    assert bool((energy.diff() <= 1e-9 * energy[0]).all())
    if damped:
        assert float(energy[-1]) < 0.5 * float(energy[0])
    else:
        assert float(energy[-1]) == pytest.approx(float(energy[0]), rel=1e-6)


def test_the_energy_of_a_state_is_kept_without_damping_and_lost_with_it(elastic: ElasticScene) -> None:
    generator = torch.Generator().manual_seed(5)
    for damped in (False, True):
        _shake(elastic, generator)
        if not damped:
            _undamped(elastic)
        before, now = (
            torch.einsum("m,ndm->nd", z, elastic.modes)[None] for z in torch.randn(2, 9, generator=generator).double()
        )
        energies = []
        for _ in range(50):
            energies.append(float(elastic.energy(now, before)))
            before, now = now, torch.einsum("sm,ndm->snd", elastic(now, before), elastic.modes)
        if damped:
            assert all(b <= a * (1 + 1e-5) for a, b in zip(energies, energies[1:], strict=False))
            assert energies[-1] < 0.97 * energies[0]
        else:
            assert energies == pytest.approx([energies[0]] * 50, rel=2e-3)  # the modes are kept in single precision


def test_single_precision_rollout_stays_bounded_for_2000_steps(make_scene) -> None:
    hierarchy = build_hierarchy(make_scene(90), radii=(0.2, 0.5))
    scene = _scene(hierarchy, period=6.0, inertia="trained")
    generator = torch.Generator().manual_seed(7)
    _shake(scene, generator)
    scene.float()
    start = torch.randn(2, 9, generator=generator)
    before, now = (torch.einsum("m,ndm->nd", z, scene.modes)[None] for z in start)
    largest = []
    for _ in range(2000):
        z = scene(now, before)
        before, now = now, torch.einsum("sm,ndm->snd", z, scene.modes)
        largest.append(float(z.abs().max()))
    assert max(largest) < 1e3 and max(largest[1000:]) <= max(largest[:1000])


def _template(make_model, scene, *, conserve_mass=True, **options):
    template = partial(ElasticTemplate, modes=9, neighbours=8, **options)
    return make_model(scene, zero_output=True, conserve_mass=conserve_mass, template=template)


@torch.no_grad()
@pytest.mark.parametrize("amount", [0.3, 60.0])
def test_template_gradients_conserve_volume(make_scene, make_model, amount) -> None:
    scene = make_scene(90, dtype=torch.float64)
    spread = {}
    for conserve in (True, False):
        model = _template(make_model, scene, conserve_mass=conserve)
        batch = model.batch((0,))
        rest = model.hierarchies[0].levels[1].rest
        modes, _, sizes = model.template.basis(0)
        now = rest + modes @ (torch.linspace(amount, -amount, 9, dtype=torch.float64) / sizes)
        state = model.prepare(batch).template(Motion(rest, now, now))
        det = torch.linalg.det(state.deformation_gradients)
        assert bool(torch.isfinite(state.deformation_gradients).all()) and float(det.min()) > 0
        spread[conserve] = float((det - 1).abs().max())
        assert float((state.deformation_gradients - torch.eye(3)).abs().max()) > 1e-3
    assert spread[True] < 1e-5 < 1e-3 < spread[False]


@torch.no_grad()
def test_simulator_carries_a_mode_through_its_whole_recursion(make_scene, make_model) -> None:
    """One undamped mode, zero network output: kernels of the full simulator swing as the formula says."""
    scene = make_scene(90, dtype=torch.float64)
    model = _template(make_model, scene, hidden=0, period=12.0)
    model.log_density[0].zero_()  # modes are those of unit density
    inner = model.template.scenes[0]
    inner.damping.fill_(-1e4)
    initial = ModalInitialStates(model, [0]).double()
    initial.velocity[0][0] = 0.5
    offset = scene.means - initial.previous(0)  # amplitude times the first mode, at every kernel
    angle = 2 * math.atan(math.pi / 12.0)
    start = SimState(scene.means, scene.means - offset * math.sin(angle))
    trajectory = SceneDynamics(model).rollout(start, 40)
    level, unit = model.hierarchies[0].levels[1], model.hierarchies[0].ancestor(0, 1)
    moved = trajectory.positions[:, model.hierarchies[0].kernels] - level.rest[unit]
    weight = model.hierarchies[0].levels[0].volume[:, None]
    centre = torch.zeros(41, level.count, 3, dtype=torch.float64).index_add(1, unit, moved * weight)
    centre = centre / level.volume[:, None]
    expected = torch.sin(angle * torch.arange(41, dtype=torch.float64))
    shape = model.template.basis(0)[0][..., 0] * 0.5
    assert float(shape.abs().max()) > 1e-3
    error = (centre - expected[:, None, None] * shape).abs().max()
    assert float(error) < 1e-5 * float(shape.abs().max()) + 1e-9


def test_parameters_are_grouped_by_role(make_scene, make_model) -> None:
    model = _template(make_model, [make_scene(60), make_scene(50, seed=1)], hidden=8)
    groups = model.parameter_groups()
    ids = [id(p) for group in groups.values() for p in group]
    assert len(ids) == len(set(ids)) and set(ids) == {id(p) for p in model.parameters()}
    assert all(any(p is q for q in groups["network"]) for p in model.template.networks())
    assert any(p is model.template.scenes[1].mixing for p in groups["template"])
    assert any(p is model.attributes[1] for p in groups["scene"])


def test_springs_pull_by_the_gradient_of_their_energy_and_not_at_all_to_first_order(make_scene) -> None:
    hierarchy = build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))
    scene = _scene(hierarchy, period=6.0, geometric=1.0)
    springs, level = scene.springs, hierarchy.levels[1]
    assert springs is not None
    pairs, blocks = spring_network(level.rest.double().numpy(), 8)
    rest, phi = level.rest.double(), scene.modes.double()
    i, j = (torch.from_numpy(p) for p in pairs.T)
    offset = rest[j] - rest[i]
    length = offset.norm(dim=-1)
    stiffness = 0.7 / length**2

    def energy(z: torch.Tensor) -> torch.Tensor:
        moved = rest + phi @ z
        stretch = (moved[j] - moved[i]).norm(dim=-1) - length
        along = ((moved[j] - moved[i] - offset) * offset).sum(-1) / length
        return 0.5 * (stiffness * (stretch**2 - along**2)).sum()

    first = phi[..., 0]
    lowest = torch.einsum("ea,eab,eb->", first[j] - first[i], torch.from_numpy(blocks), first[j] - first[i])
    generator = torch.Generator().manual_seed(3)
    for size in (0.3, 3.0):
        z = (size * scene.scale * torch.randn(9, generator=generator, dtype=torch.float64)).requires_grad_()
        expected = -torch.autograd.grad(energy(z), z)[0] / lowest
        torch.testing.assert_close(
            springs(z.detach()[None])[0], expected, rtol=1e-3, atol=1e-4 * float(expected.norm())
        )
        potential = springs.potential(z[None])[0]
        torch.testing.assert_close(potential, energy(z) / lowest, rtol=1e-3, atol=1e-5 * float(potential.abs()))
        z = z.detach()
    pulls = [float(springs(s * z[None]).norm()) for s in (1e-3, 2e-3)]
    assert pulls[1] / pulls[0] == pytest.approx(4, rel=0.02) and not bool(springs(0 * z[None]).any())
    # It takes part in the step with its trained gain.
    basis = phi.flatten(0, 1)
    now, before = (s * (basis @ z).view(1, -1, 3) for s in (1.0, 0.9))
    a, b, h = scene.matrices()
    stiff = torch.tensor(scene.initial_log_stiffness).exp()
    torch.testing.assert_close(scene(now, before)[0], a @ z - b @ (0.9 * z) + h @ (stiff * springs(z[None])[0]),
                               rtol=1e-4, atol=1e-8)  # fmt: skip


def test_springs_never_add_more_than_half_of_what_the_stiffness_pulls(make_scene) -> None:
    hierarchy = build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))
    own = {"period": 6.0, "damping": "modal", "inertia": "trained"}
    scene, plain = _scene(hierarchy, **own, geometric=1.0), _scene(hierarchy, **own)
    a, b, _ = scene.matrices()
    z = torch.randn(5, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shares = []
    for size in (0.1, 10.0, 1e4):
        now = torch.einsum("sm,ndm->snd", size * scene.scale * z, scene.modes.double())
        added = (scene(now, now) - plain(now, now)).norm(dim=-1)
        pull = ((size * scene.scale * z) @ (torch.eye(9) - a + b).mT).norm(dim=-1)
        shares.append(added / pull)
    assert float(shares[0].max()) < 0.1 < float(shares[1].max())
    torch.testing.assert_close(shares[2], torch.full((5,), 0.5, dtype=torch.float64), rtol=1e-3, atol=0)


def test_trained_inertia_is_the_equation_of_motion_with_another_mass(make_scene) -> None:
    """Against M (z'' + ...) solved as it is written, with the forces of springs and the energy that goes with them."""
    hierarchy = build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))
    scene = _scene(hierarchy, inertia="trained", geometric=1.0)
    generator = torch.Generator().manual_seed(3)
    begun = scene.mixing_size()
    for p in (scene.mixing, scene.damping_mixing, scene.inertia_mixing):
        p.copy_(0.3 * torch.randn(p.shape, generator=generator, dtype=torch.float64))
    total = sum(float((0.3 * p).square().sum()) for p in (scene.mixing, scene.damping_mixing, scene.inertia_mixing))
    assert float(begun) == 0 and float(scene.mixing_size()) == pytest.approx(total)
    root, mixing = scene.roots()
    heavy = torch.eye(9, dtype=torch.float64) + 0.3 * scene.inertia_mixing
    mass, inner = heavy.mT @ heavy, root[:, None] * mixing
    stiffness, damping = heavy.mT @ inner @ inner.mT @ heavy, heavy.mT @ scene.dissipation() @ heavy
    z, before = 0.01 * torch.randn(2, 1, 9, generator=generator, dtype=torch.float64)
    size = torch.tensor(scene.initial_log_stiffness).exp() * scene.gain
    force = size * scene.springs(z)
    right = z @ (2 * mass - stiffness / 2) - before @ (mass + stiffness / 4 - damping / 2) + force
    expected = torch.linalg.solve(mass + stiffness / 4 + damping / 2, right[0])
    place = [torch.einsum("sm,ndm->snd", x, scene.modes) for x in (z, before)]
    torch.testing.assert_close(scene(*place)[0], expected, rtol=1e-4, atol=1e-9)
    step, middle = (z - before)[0], (z + before)[0] / 2
    energy = (step @ mass @ step + middle @ stiffness @ middle) / 2 + size * scene.springs.potential(middle[None])[0]
    assert float(scene.energy(*place)) == pytest.approx(float(energy), rel=1e-4)


def test_dampings_are_what_they_are_called(make_scene) -> None:
    hierarchy = build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))
    found = {}
    for name in ("modal", "rayleigh", "structural"):
        scene = _scene(hierarchy, damping=name)
        scene.damping.copy_(torch.arange(len(scene.damping)) / 10)
        a, b, inverse = scene.matrices()
        identity = torch.eye(9, dtype=torch.float64)
        damping = torch.linalg.solve(inverse, identity - b) @ identity  # (I + K/4 + D/2) (I - B) = D
        stiffness = 2 * (2 * identity - torch.linalg.solve(inverse, a))
        found[name] = damping, stiffness.diagonal(), (-4 + 2 * scene.damping).exp()
        assert torch.allclose(damping, torch.diag(damping.diagonal()), atol=1e-9)  # without mixing
        torch.testing.assert_close(scene.dissipation(), damping, rtol=1e-6, atol=1e-9)
    for name, (damping, stiffness, rates) in found.items():
        if name == "modal":
            expected = rates
        else:
            expected = rates[0] + rates[1] * stiffness if name == "rayleigh" else 2 * rates * stiffness.sqrt()
        torch.testing.assert_close(damping.diagonal(), expected, rtol=1e-6, atol=1e-9)
