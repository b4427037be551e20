"""The step of the modes and their springs: its solution, its energy, and how forces move it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bodies import NEURAL, neural_model, pull_of
from torch import Tensor

from gausim.core import SimState
from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.grid import FIRST, SECOND
from gausim.models.template.material import DAMPING_GAIN, Links
from gausim.models.template.reduced import reduced_step
from gausim.models.template.solid import SolidSettings
from gausim.models.template.springs import Springs
from gausim.ops.rotation import quaternion_to_matrix

# Bodies whose springs are what is nonlinear, and whose cells are.
LAWS = pytest.mark.parametrize("law", ["springs", "solid"])


@LAWS
@torch.no_grad()
def test_the_step_solves_its_equation(law: str) -> None:
    part = neural_model(law=law).modal_scene(0)
    z, previous = 0.01 * torch.randn(2, 1, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    after = part.after(z, previous)
    ends = [part.nonlinear.strain_state(middle) for middle in ((z + previous) / 2, (after + z) / 2)]
    bend, force = after - 2 * z + previous, part.nonlinear.between(*ends, part.factor, part.growth)
    lost = (z + bend / 4) @ part.stiffness + (z - previous + bend / 2) @ part.damping
    torch.testing.assert_close(bend @ part.inertia, force - lost, rtol=1e-3, atol=1e-3 * float(lost.abs().max()))
    step, middle = (z - previous)[0], (z + previous)[0] / 2
    energy = (step @ part.inertia @ step + middle @ part.stiffness @ middle) / 2
    torch.testing.assert_close(part.energy(z, previous)[0], energy + part.nonlinear.potential(ends[0], part.factor)[0])


@LAWS
@torch.no_grad()
def test_a_step_like_another_is_solved_without_stiffness(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    part = neural_model(law=law).modal_scene(0)
    part.corrections, part.solved = 8, 1e-4
    z, previous = 0.01 * torch.randn(2, 1, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    known, near, true = part.solve(z, previous), (1.05 * z, previous), part.after(1.05 * z, previous)
    monkeypatch.delattr(type(part.nonlinear), "stiffening")
    step = part.solve(*near, near=known)
    torch.testing.assert_close(step.after, true, rtol=1e-3, atol=1e-3 * float(true.abs().max()))
    assert torch.equal(step.inverse, known.inverse)


@LAWS
def test_loss_gradients_of_a_step_are_those_of_its_solution(law: str) -> None:
    part = neural_model(law=law).modal_scene(0)
    part.solved = 1e-12
    own = ("inertia", "stiffness", "damping", "factor", "growth")
    for name in own:
        setattr(part, name, getattr(part, name).detach().requires_grad_())
    draws = torch.Generator().manual_seed(2)
    z, previous, slope = 0.02 * torch.randn(3, 2, 9, generator=draws, dtype=torch.float64)
    inputs = [z.requires_grad_(), previous.requires_grad_(), *(getattr(part, name) for name in own)]
    found = torch.autograd.grad((part.solve(z, previous).after * slope).sum(), inputs)
    with torch.no_grad():
        for given, gradient in zip(inputs, found, strict=True):
            step = 1e-5 * torch.randn(given.shape, generator=draws, dtype=torch.float64) * (given.abs().mean() + 1e-3)
            before, ends = given.clone(), []
            for sign in (1, -1):
                given.copy_(before + sign * step)
                ends.append(float((part.solve(z, previous).after * slope).sum()))
            given.copy_(before)
            assert float((gradient * step).sum()) == pytest.approx((ends[0] - ends[1]) / 2, rel=0.02)


@LAWS
@torch.no_grad()
def test_resistance_to_growth_takes_the_energy_that_is_lost_and_none_from_a_rotation(law: str) -> None:
    template = partial(NEURAL["template"], solid=SolidSettings(0.12, 0.0), links=Links(12, damping=0.1), hidden=48)
    part = neural_model(law=law, template=template).modal_scene(0)
    part.corrections = 30  # the usual ones leave more unsolved than growth takes
    part.damping = torch.zeros_like(part.damping)
    before, now = 0.02 * torch.randn(2, 1, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    energies, taken = [], []
    for _ in range(40):
        energies.append(part.energy(now, before))
        after = part.after(now, before)
        taken.append(part.dissipated(after, now, before))
        before, now = now, after
    energy, lost = torch.cat(energies), torch.cat(taken)
    torch.testing.assert_close(-energy.diff(), lost[:-1], rtol=1e-3, atol=1e-4 * float(energy[0]))
    assert float(energy[-1]) < 0.9 * float(energy[0]) and bool((lost > 0).all())
    body, turn = part.nonlinear, quaternion_to_matrix(torch.tensor([0.9, 0.1, -0.3, 0.3], dtype=torch.float64))
    turned = (turn - torch.eye(3)).flatten().expand(1, len(part.motions) // 12, 9)
    ends = body.strain_state(0 * now), body.strain_state(0 * now, body.reference_strain(turned))
    assert float(body.dissipated(*ends, part.factor, 0.1)) < 1e-12


@torch.no_grad()
def test_a_step_keeps_energy_where_springs_are_far_stiffer_than_inertia() -> None:
    """A swing that turns springs by a tenth in a frame, the stiffest of them at 28 radians per frame."""
    template = partial(NEURAL["template"], modes=24, links=Links(8, damping=0.0), hidden=48)
    part = neural_model(law="springs", template=template).modal_scene(0)
    springs, times = part.nonlinear, 1.2
    along = (springs.offset[..., None] * springs.modes.unflatten(0, (-1, 3))).sum(1) / springs.length[:, None]
    part.stiffness = part.stiffness + along.mT @ (((times - 1) * part.factor * springs.stiffness)[:, None] * along)
    part.factor, part.damping = times * part.factor, torch.zeros_like(part.damping)
    squares, modes = torch.linalg.eigh(part.stiffness)
    assert float(squares[-1]) > 700
    slowest = modes[:, 0]
    slowest = slowest / (part.motions.unflatten(0, (-1, 12))[:, :3] @ slowest).norm(dim=-1).max()

    def swing() -> torch.Tensor:
        found = [0.7 * 0.3 * slowest[None], 0.3 * slowest[None]]
        for _ in range(20):
            found.append(part.after(found[-1], found[-2]))
        return torch.stack(found)

    made = swing()
    part.corrections = 30
    exact = swing()
    assert float((made - exact).norm() / exact.norm()) < 0.05
    energies = [[float(part.energy(z[i + 1], z[i])) for i in range(len(z) - 1)] for z in (made, exact)]
    assert max(energies[0]) < 1.01 * energies[0][0] and energies[1][-1] == pytest.approx(energies[1][0], rel=1e-9)


@torch.no_grad()
def test_forces_move_fast_modes_as_far_as_they_should() -> None:
    """A force of one frame swings every linear mode by v sin(w t) / w; a steady one ends where K z = M a."""
    model = neural_model(lever=0.0, output_scale=0.0)
    batch, scene = model.batch((0,)), model.scenes[0]
    prepared = model.prepare(batch)
    part = prepared.template.parts[0][0]
    part.factor, part.damping = torch.zeros_like(part.factor), torch.zeros_like(part.damping)
    part.stiffness = 20 * part.stiffness
    speed = 0.01 * torch.randn(9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    accelerations = (part.positions @ speed).view(-1, 3)[batch.finest[batch.simulated]] @ prepared.frames.axes[-1][0]
    force = torch.zeros_like(scene.means)
    force[scene.simulated] = prepared.mass[:, None] * accelerations / batch.dt**2

    def rollout(frames: int, pushed: int) -> torch.Tensor:
        state, found = SimState(scene.means, scene.means), []
        for frame in range(frames):
            made = model.step(batch, state, force if frame < pushed else None, prepared)
            state = SimState(made.positions, state.positions)
            change = (prepared.finest(state.positions) - prepared.levels[-1].rest)[None]
            found.append(part.coordinates(change, change)[0][0])
        return torch.stack(found)

    lower = torch.linalg.cholesky(part.inertia)
    inverse = torch.linalg.inv(lower)
    squares, modes = torch.linalg.eigh(inverse @ part.stiffness @ inverse.mT)
    assert float(squares[-1]) > 100
    swings, velocities = rollout(20, 1) @ lower @ modes, speed @ part.mass @ inverse.mT @ modes
    turns = 2 * torch.atan(squares.sqrt() / 2) * torch.arange(1, 21)[:, None]
    torch.testing.assert_close(swings, velocities / squares.sqrt() * torch.sin(turns), atol=1e-5, rtol=1e-3)
    part.damping = 0.2 * (part.inertia + part.stiffness / 4)
    vars(part).pop("_reached")  # what was computed with the damping of 0
    still = torch.linalg.solve(part.stiffness, part.mass @ speed)
    torch.testing.assert_close(rollout(150, 150)[-1], still, atol=1e-6, rtol=1e-3)


@torch.no_grad()
def test_the_template_keeps_its_energy_without_damping_and_loses_it_with_it() -> None:
    model = neural_model(lever=0.0, output_scale=0.0)
    batch, scene = model.batch((0,)), model.scenes[0]
    body = model.template.body(0)
    start = model.smooth_motions(0).kernels @ torch.linspace(1, 0.2, 9, dtype=torch.float64)
    for damping, low, high in ((-40.0, 1 - 1e-4, 1 + 1e-4), (0.0, 0.0, 0.5)):
        model.template.damping.fill_(damping / DAMPING_GAIN)
        prepared = model.prepare(batch)
        ((part, _, _),) = prepared.template.parts  # without links beyond the linear: only K is kept exactly
        part.factor = torch.zeros_like(part.factor)
        state = SimState(scene.means, scene.means - start)
        first = float(model.energy(batch, state, prepared))
        for _ in range(60):
            step = model.step(batch, state, prepared=prepared)
            state = SimState(step.positions, state.positions)
        assert low <= float(model.energy(batch, state, prepared)) / first <= high
    assert body.scale > 0


@torch.no_grad()
def test_arrays_give_energy_and_damping() -> None:
    part = neural_model().modal_scene(0)
    arrays, numbers = reduced_step(part)
    z = torch.randn(3, len(part.stiffness), generator=torch.Generator().manual_seed(0)).double()
    gradient = np.einsum("ncm,sm->snc", arrays["cells"], z.numpy()).reshape(3, -1, 3, 3)
    small = (gradient + gradient.swapaxes(-1, -2)) / 2
    green = small + gradient.swapaxes(-1, -2) @ gradient / 2
    shear, bulk = arrays["moduli"].T / 2
    whole, linear = (shear * (e**2).sum((-1, -2)) + bulk * np.trace(e, axis1=-2, axis2=-1) ** 2 for e in (green, small))
    expected = part.nonlinear.potential(part.nonlinear.strain_state(z), part.factor)
    np.testing.assert_allclose((whole - linear).sum(-1), expected.numpy(), rtol=1e-4)
    again = arrays["drag"] + numbers["viscosity"] * arrays["stiffness"]
    again = again + numbers["rate"] * (part.inertia - part.mass).numpy()
    np.testing.assert_allclose(again, part.damping.numpy(), rtol=1e-6, atol=1e-9)


UNITS, MODES = 7, 5
EYE = torch.eye(3, dtype=torch.float64)
DRAW = np.random.default_rng(0)
CELLS = FiniteStrain(DRAW.normal(size=(UNITS, 9, MODES)), DRAW.random(UNITS)).double()
ENDS = np.array([[0, 0, 1, 2, 2, 3, 4, 5, 1, 0], [1, 2, 3, 3, 4, 5, 6, 6, 6, 5]])
REST, PHI = DRAW.normal(size=(UNITS, 3)), DRAW.normal(size=(UNITS, 3, MODES))
SPRINGS = Springs(ENDS, REST, PHI, DRAW.random(ENDS.shape[1]) + 0.5).double()
FORCES = pytest.mark.parametrize("law", [CELLS, SPRINGS], ids=["cells", "springs"])


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


@FORCES
def test_the_force_is_the_slope_of_the_potential_and_of_second_order(law: Any) -> None:
    z, factor = _states(0.2)[0].requires_grad_(), _factor(law)
    (slope,) = torch.autograd.grad(law.potential(law.strain_state(z), factor).sum(), z)
    torch.testing.assert_close(pull_of(law, z, factor), -slope)
    small, large = (pull_of(law, size * z.detach(), factor).norm() for size in (1e-4, 1e-3))
    assert float(small / large) == pytest.approx(0.01, rel=0.1) and not pull_of(law, 0 * z, factor).any()


@FORCES
@pytest.mark.parametrize("damping", [0.0, 0.3])
@torch.no_grad()
def test_the_work_of_the_mean_force_is_what_the_energy_loses(law: Any, damping: float) -> None:
    (z, other), factor = _states(0.3), _factor(law)
    first, second = law.strain_state(z), law.strain_state(other)
    work = (law.between(first, second, factor, damping) * (other - z)).sum(-1)
    lost = law.potential(first, factor) - law.potential(second, factor)
    torch.testing.assert_close(work, lost - law.dissipated(first, second, factor, damping))
    assert bool((law.dissipated(first, second, factor, 0.3) > 0).all())


@FORCES
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


@FORCES
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
