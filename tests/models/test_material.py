"""The solid body whose material a shared network decodes from densities and attributes."""

import math
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
import pytest
import torch
from helpers.bodies import NEURAL, make_model, make_scene, make_state, neural_model
from helpers.simulators import silence

from gausim.core import Adjustable, ConfigError, SimState
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.models.rollout.dynamics import scene_dynamics
from gausim.models.template.body_modes import CURVED
from gausim.models.template.material import Damping, Links, MaterialTemplate, PreparedMaterial
from gausim.models.template.solid import SolidBody, solid_body
from gausim.ops.rotation import quaternion_to_matrix


def _template(hierarchy, *, seed: int = 0, **settings) -> MaterialTemplate:
    """In double precision, its decoders and attributes random."""
    torch.manual_seed(seed)
    made = NEURAL["template"]([hierarchy], 1, attributes=3, frames=[np.eye(3)], **settings)
    return made.double().requires_grad_(False)


@pytest.fixture(scope="module")
def hierarchy():
    return build_hierarchy(make_scene(90, dtype=torch.float64), radii=(0.2, 0.5))


def _material(hierarchy, *, seed: int = 1):
    generator = torch.Generator().manual_seed(seed)
    count = hierarchy.levels[1].count
    draw = partial(torch.randn, generator=generator, dtype=torch.float64)
    return 0.5 * draw(count), draw(count, 3)


def _solid(hierarchy) -> SolidBody:
    """The body that the template is made from."""
    kernels, level = hierarchy.levels[:2]
    mass = (level.volume / level.volume[~level.pinned].mean()).double().numpy()
    rest = [x.rest.double().numpy() for x in (kernels, level)]
    return solid_body(rest[0], kernels.pinned.numpy(), rest[1], mass, level.pinned.numpy(),
                      modes=9, spacing=0.2 * hierarchy.diagonal, curved=CURVED)  # fmt: skip


def test_parts_of_the_units_sum_up_to_the_homogeneous_body(hierarchy) -> None:
    template, level = _template(hierarchy), hierarchy.levels[1]
    body = template.body(0)
    expected = _solid(hierarchy)
    values = torch.from_numpy(expected.values / expected.values[0])
    torch.testing.assert_close(body.stiffness.sum((0, 1)), torch.diag(values), atol=1e-4, rtol=1e-4)
    root = body.inertia.flatten(0, 1)
    torch.testing.assert_close(root.mT @ root, torch.eye(9, dtype=torch.float64), atol=1e-5, rtol=0)
    assert not body.modes[level.pinned].any()


@pytest.mark.parametrize("c0", [0.02, 0.0])
def test_matrices_are_sums_over_units(hierarchy, c0: float) -> None:
    """Against the equations of the module's text, written out unit by unit; with and without drag."""
    template, (density, attributes) = _template(hierarchy, damping=Damping(c0, 0.02)), _material(hierarchy)
    body = template.body(0)
    units, _ = template.decode(body, attributes)
    found = template.matrices(0, density, attributes, 1 / 24)
    k, c1 = (2 * np.pi / 8) ** 2, 0.02
    rho = (2.5 * torch.tanh(density / 2.5)).exp()
    lost = torch.tanh(c0 * units[:, 2].exp() / 2)
    stiffness, inertia, drag = (torch.zeros(9, 9, dtype=torch.float64) for _ in range(3))
    for i in range(len(density)):
        own = sum(torch.outer(body.inertia[i, a], body.inertia[i, a]) for a in range(3))
        stiffness += units[i, 0].exp() * body.stiffness[0, i] + units[i, 1].exp() * body.stiffness[1, i]
        inertia += rho[i] * own
        drag += 2 * rho[i] * lost[i] * own
    torch.testing.assert_close(found.stiffness, k * stiffness)
    torch.testing.assert_close(found.mass, inertia)
    slowed = (found.inertia - inertia).diagonal()
    torch.testing.assert_close(found.inertia, inertia + slowed.diag())
    fastest = k * stiffness.diagonal() / (4 * np.pi) ** 2  # two swings a frame
    torch.testing.assert_close(inertia.diagonal() + slowed, torch.maximum(inertia.diagonal(), fastest))
    assert 0 < int((slowed > 0).sum()) < 9
    rate = drag.trace() / inertia.trace()
    torch.testing.assert_close(found.damping, drag + rate * slowed.diag() + (c1 + rate / 4) * k * stiffness)
    assert not len(found.springs)
    torch.testing.assert_close(found.units, k * units[:, :2].exp())
    for matrix in (found.stiffness, found.inertia, found.damping):
        assert float(torch.linalg.eigvalsh(matrix)[0]) > -1e-9


def test_springs_add_their_stiffness_and_no_mass(hierarchy) -> None:
    solid, net = _template(hierarchy), _template(replace(hierarchy, law="springs"))
    material, dt, ends = _material(hierarchy), 1 / 24, net.body(0).springs.ends
    found = net.matrices(0, *material, dt)
    # The same vibrations, the lowest ones, are among the modes of both laws.
    modes, k = len(net.body(0).values), (2 * np.pi / 8) ** 2
    count = modes - modes // 2
    torch.testing.assert_close(found.mass, _masses(net.body(0), material[0]))
    stretch = net.body(0).stretch
    springs = stretch.mT @ (net.decode(net.body(0), material[1])[1].exp()[:, None] * stretch)
    cells = solid.matrices(0, *material, dt).stiffness[:count, :count]
    both = (k * springs)[:count, :count] + cells
    torch.testing.assert_close(found.stiffness[:count, :count], both, atol=1e-4, rtol=0)
    assert len(found.springs) == ends.shape[1] > 0


def test_only_nets_have_matrices_of_their_own_and_are_above_their_springs(hierarchy) -> None:
    assert not _template(hierarchy).nets
    net, material = _template(replace(hierarchy, law="springs")), _material(hierarchy)
    even, stretch = net.matrices(0, *material, 1 / 24), net.body(0).stretch
    net.nets["0"].normal_(generator=torch.Generator().manual_seed(5))
    found, (between, moved) = net.matrices(0, *material, 1 / 24), torch.eye(9).double() + 0.3 * net.nets["0"]
    springs = stretch.mT @ (found.springs[:, None] * stretch)
    root = torch.linalg.cholesky(even.stiffness - springs) @ between
    torch.testing.assert_close(found.stiffness - springs, root @ root.mT, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.mass, moved.mT @ even.mass @ moved)
    assert float(torch.linalg.eigvalsh(found.stiffness - springs)[0]) > 0
    torch.testing.assert_close(found.damping, 0.02 * found.stiffness)
    assert net.own(0, "template.") == ("template.nets.0",)


def _masses(body, density):
    rho = (2.5 * torch.tanh(density / 2.5)).exp()
    return torch.einsum("n,nal,nam->lm", rho, body.inertia, body.inertia)


def test_without_drag_training_adds_none(hierarchy) -> None:
    template, (density, attributes) = _template(hierarchy, damping=Damping(0.0, 0.02)), _material(hierarchy)
    template.requires_grad_(True)
    attributes.requires_grad_(True)
    template.matrices(0, density, attributes, 1 / 24).damping.sum().backward()
    slopes = [attributes.grad, *(p.grad for p in template.parameters() if p.grad is not None)]
    assert all(torch.isfinite(slope).all() for slope in slopes)
    assert template.damping.grad[0] == 0 != template.damping.grad[1]
    units = mock.Mock(spec=FixedUnits, attributes=attributes.detach(), log_density=density)
    assert set(template.material(0, units, 24.0)) == {"density", "stiffness"}
    with pytest.raises(ConfigError, match=r"damping.drag is 0"):
        _ = template.log_drag


def test_springs_have_no_drag_and_half_the_frame_rate_is_the_same_body(hierarchy) -> None:
    template, material = _template(replace(hierarchy, law="springs"), damping=Damping(0.02, 0.03)), _material(hierarchy)
    before = template.matrices(0, *material, 1 / 24)
    template.damping.fill_(1.0)
    template.growth.fill_(1.0)
    after = template.matrices(0, *material, 1 / 24)
    torch.testing.assert_close(after.damping, before.damping)
    assert after.growth == before.growth
    torch.testing.assert_close(before.damping, 0.03 * before.stiffness)
    assert not template.has_drag(0) and _template(hierarchy).has_drag(0)
    template, (density, attributes) = _template(hierarchy), _material(hierarchy)
    fast, slow = (template.matrices(0, density, attributes, dt) for dt in (1 / 48, 1 / 24))
    torch.testing.assert_close(slow.stiffness, 4 * fast.stiffness)
    torch.testing.assert_close(slow.mass, fast.mass)


def test_only_pinned_solids_train_their_resistance_to_growth(hierarchy) -> None:
    template, material = _template(hierarchy, links=Links(4, damping=0.03)), _material(hierarchy)
    template.growth.fill_(1.0)
    assert float(template.matrices(0, *material, 1 / 24).growth) == pytest.approx(0.03 * math.e**2)
    template.is_pinned = [False]
    assert float(template.matrices(0, *material, 1 / 24).growth) == pytest.approx(0.03)


@pytest.mark.parametrize("finite", [True, False])
def test_cells_or_springs_are_what_is_nonlinear(hierarchy, finite: bool) -> None:
    """In the state z each pulls by minus the slope of its own energy, as strong as K says that it is."""
    hierarchy = replace(hierarchy, law="solid" if finite else "springs")
    template = _template(hierarchy, links=Links(4, damping=0.1))
    body, matrices = template.body(0), template.matrices(0, *_material(hierarchy), 1 / 48)
    part = PreparedMaterial(body, matrices, 1.0)
    z = 0.1 * torch.randn(1, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    if finite:
        expected = body.cells.potential(body.cells.strain_state(z), matrices.units)
        linear = torch.einsum("np,pnlm->lm", matrices.units, body.stiffness)
    else:
        expected = body.springs.potential(body.springs.strain_state(z), matrices.springs)
        linear = body.stretch.mT @ (matrices.springs[:, None] * body.stretch)
    still = 0.5 * ((z @ part.stiffness) * z).sum(-1)
    torch.testing.assert_close(part.energy(z, z), still + expected)
    small = part.nonlinear.strain_state(1e-4 * z)
    if finite:  # the mean strain near a unit lacks what varies around it
        gradient = (small.gradient + small.gradient.mT) / 2
        energy = (body.cells._stress(gradient, matrices.units) * gradient).sum()
    else:
        energy = (matrices.springs * body.springs.stiffness * small.stretch[0].square()).sum()
    ratio = float(energy / (1e-8 * (z @ linear @ z.mT)))
    assert (0.7 < ratio < 1) if finite else ratio == pytest.approx(1, rel=0.01)
    assert float(part.growth) == pytest.approx(0.2)  # half a frame at 24 per second is one at 48


@pytest.mark.parametrize("frames", [24, 48])
def test_an_even_drag_damps_all_modes_alike_however_fast_and_strong_it_is(hierarchy, frames: int) -> None:
    """Amplitudes fall as exp(-c t / 2): the product of the two roots of a mode's step is exp(-c) a frame."""
    template, free = _template(hierarchy), hierarchy.levels[1].count
    for weight in (*template.unit_decoder.parameters(), *template.link_decoder.parameters()):
        weight.zero_()
    template.damping[1] = -np.inf  # no viscosity
    for strength in (0.01, 1.0, 5.0):
        attributes = torch.zeros(free, 3, dtype=torch.float64)
        attributes[:, 1] = np.log(strength / 0.02)
        found = template.matrices(0, torch.zeros(free, dtype=torch.float64), attributes, 1 / frames)
        implicit, half = found.inertia + found.stiffness / 4, found.damping / 2
        product = torch.linalg.solve(implicit + half, implicit - half)
        expected = np.exp(-strength * 24 / frames) * torch.eye(9, dtype=torch.float64)
        torch.testing.assert_close(product, expected, atol=1e-6, rtol=0)


def test_a_strained_reference_pulls_where_the_body_is_stiffer_than_a_homogeneous_one(hierarchy) -> None:
    """An even strain S of an evenly stiffer body: minus the integral of the stress of S against the modes' strain."""
    template, body, count = _template(hierarchy), _solid(hierarchy), hierarchy.levels[1].count
    slope = torch.from_numpy(body.at(body.centres)[1])
    even = torch.tensor([[0.3, 0.1, 0.0], [0.1, -0.2, 0.05], [0.0, 0.05, 0.1]], dtype=torch.float64)
    lame, shear = 0.3 / (1.3 * 0.4), 1 / 2.6  # of Young's modulus 1 and Poisson's ratio 0.3
    stress = 2 * shear * 0.7 * even + lame * 0.2 * even.trace() * torch.eye(3, dtype=torch.float64)
    expected = -torch.einsum("q,qabm,ab->m", torch.from_numpy(body.weights), slope, stress) / body.values[0]
    matrices = template.matrices(0, *(0.0 * x for x in _material(hierarchy)), 1 / 24)
    assert not matrices.uneven.any()
    uneven = torch.tensor([0.7, 0.2]).double().expand(count, 2)
    part = PreparedMaterial(template.body(0), replace(matrices, uneven=uneven, tense=0 * matrices.tense), 1.0)
    load = torch.cat((torch.zeros(3), even.flatten())).double().expand(1, count, 12)
    torch.testing.assert_close(part.force(load)[0], expected, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_rest_is_an_equilibrium_whatever_the_weights() -> None:
    model = neural_model(output_scale=1.0)
    batch = model.batch((0,))
    step = model.step(batch, SimState(batch.rest, batch.rest))
    torch.testing.assert_close(step.positions, batch.rest, atol=1e-9, rtol=0)
    loose = neural_model(output_scale=1.0, anchor=False)
    step = loose.step(loose.batch((0,)), SimState(batch.rest, batch.rest))
    assert float((step.positions - batch.rest).abs().max()) > 1e-4


def _inputs(model) -> list:
    """Units and template positions that the network is asked about in a step."""
    asked = []
    with mock.patch.object(model.predictor, "forward", side_effect=model.predictor.forward) as ask:
        model.step(model.batch((0,)), make_state(model.scenes[0]))
    for call in ask.call_args_list:
        _, unit, _, target, _ = call.args
        asked.append((unit, target))
    return asked


@torch.no_grad()
def test_network_sees_the_middle_of_the_step() -> None:
    """Centred inputs are (x_{t+1} + 2 x_t + x_{t-1}) / 4 of the template's motion, at every level."""
    plain, centred = (_inputs(neural_model(centred=centred)) for centred in (False, True))
    assert len(centred) >= 2 * len(neural_model().predicted_levels)
    for (unit, target), (other, same) in zip(plain, centred, strict=True):
        torch.testing.assert_close(same, target)
        torch.testing.assert_close(other.before, unit.before)
        torch.testing.assert_close(other.now, (target + 2 * unit.now + unit.before) / 4)
    assert any(not torch.equal(unit.now, other.now) for (unit, _), (other, _) in zip(plain, centred, strict=True))


def _moved(scene, turn, shift):
    return replace(scene, means=scene.means @ turn.mT + shift)


@pytest.mark.parametrize("framed", [True, False])
@torch.no_grad()
def test_a_turned_and_moved_scene_moves_likewise(framed: bool) -> None:
    scene = make_scene(90, dtype=torch.float64)
    turn = quaternion_to_matrix(torch.tensor([0.5, -0.3, 0.7, 0.4], dtype=torch.float64))
    shift = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
    model = make_model(scene, **(NEURAL | {"body_frame": framed, "output_scale": 1.0}))
    other = make_model(_moved(scene, turn, shift), **(NEURAL | {"body_frame": framed, "output_scale": 1.0}))
    other.load_state_dict(model.state_dict())
    state = make_state(scene)
    turned = SimState(*(p @ turn.mT + shift for p in (state.positions, state.previous)))
    made, there = model.step(model.batch((0,)), state), other.step(other.batch((0,)), turned)
    violation = (there.positions - (made.positions @ turn.mT + shift)).abs().max() / scene.diagonal
    assert (float(violation) < 1e-6) == framed
    if framed:
        units = [m.batch((0,)).members[0].unit_of_kernel for m in (model, other)]  # their order may differ
        there_own, own = there.deformation_gradients[units[1]], turn @ made.deformation_gradients[units[0]] @ turn.mT
        torch.testing.assert_close(there_own, own, atol=1e-6, rtol=0)


def test_everything_of_the_model_learns() -> None:
    model = neural_model(template=partial(NEURAL["template"], links=Links(4)))
    batch, state = model.batch((0,)), make_state(model.scenes[0])
    prepared = model.prepare(batch)
    step = model.step(batch, state, prepared=prepared)
    step = model.step(batch, SimState(step.positions, state.positions), prepared=prepared)
    (step.positions.square().sum() + step.momentum).backward()
    still = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    # What is taken off again at rest, and what decodes springs, of which a solid body has none.
    assert not [n for n in still if "unit_decoder.2.bias" not in n and "link_decoder" not in n], still


@torch.no_grad()
def test_millimetres_move_like_metres() -> None:
    scene = make_scene(90, dtype=torch.float64)
    large = replace(scene, means=1000 * scene.means, log_scales=scene.log_scales + np.log(1000.0))
    model, other = make_model(scene, **NEURAL), make_model(large, **NEURAL)
    other.load_state_dict(model.state_dict())
    state = make_state(scene)
    step = model.step(model.batch((0,)), state)
    there = other.step(other.batch((0,)), SimState(1000 * state.positions, 1000 * state.previous))
    torch.testing.assert_close(there.positions / 1000, step.positions, atol=1e-7, rtol=0)
    torch.testing.assert_close(there.momentum, step.momentum, rtol=1e-4, atol=1e-12)


def _jacobian(model) -> np.ndarray:
    """Of the free units' step at rest by their displacements in both frames, (count, 2 count)."""
    batch = model.batch((0,))
    prepared, free = model.prepare(batch), batch.levels[-1].free[:, 0].bool()

    def step(shifts: torch.Tensor) -> torch.Tensor:
        moved = batch.rest + (shifts * free[:, None]).index_select(1, batch.finest)
        return prepared.mean(model.step(batch, SimState(*moved), prepared=prepared).positions)[free]

    blocks = torch.autograd.functional.jacobian(step, torch.zeros(2, len(free), 3).double(), vectorize=True)
    return blocks[:, :, :, free].flatten(3).movedim(2, 3).flatten(0, 1).flatten(1).numpy()


def test_the_network_reads_only_what_the_modes_carry() -> None:
    """A state is nine modal coordinates and their step; what the network does at rest is part of the Jacobian."""
    model = neural_model()
    with torch.no_grad():
        for weights in model.predictor.network.decoder.parameters():
            weights.normal_(generator=torch.Generator().manual_seed(3))
    found = _jacobian(model)
    alone = np.linalg.svd(found, compute_uv=False)
    assert len(found) == 90 and (alone > 1e-6 * alone[0]).sum() == 18
    silence(model)
    assert np.abs(_jacobian(model) - found).max() > 1e-3 * np.abs(found).max()


@torch.no_grad()
def test_stiff_bodies_do_not_tremble_ever_more_after_a_large_displacement() -> None:
    """Modes far too fast for the frames, and units that turn far: explicit forces would make them grow."""
    model = neural_model(lever=0.0, output_scale=0.0)
    model.template.stiffness.fill_(0.35)  # thirty times as stiff
    batch, scene = model.batch((0,)), model.scenes[0]
    prepared = model.prepare(batch)
    moved = scene.means + model.smooth_motions(0).kernels @ torch.linspace(1, 0.5, 9, dtype=torch.float64)
    state, energies = SimState(moved, moved), []
    for _ in range(80):
        energies.append(float(model.energy(batch, state, prepared)))
        step = model.step(batch, state, prepared=prepared)
        state = SimState(step.positions, state.positions)
    assert max(energies) < 1.001 * energies[0] and energies[-1] < 0.5 * energies[0]
    assert float((state.positions - scene.means).norm()) < 0.5 * float((moved - scene.means).norm())


def test_the_material_of_the_units_is_told_as_it_enters_the_matrices(hierarchy) -> None:
    template, count = _template(hierarchy), hierarchy.levels[1].count
    units, none = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    zeros = torch.zeros(count, 3, dtype=torch.float64)
    fixed = FixedUnits(zeros, zeros[:, 0], zeros[:, 0], zeros[:, 0] + 9, zeros, zeros[:, :1])

    def told(units):
        with mock.patch.object(template, "decode", return_value=(units, none)):
            return {name: found.values for name, found in template.material(0, fixed, 30.0).items()}

    even = told(units)
    torch.testing.assert_close(even["stiffness"], torch.ones(count).double())
    torch.testing.assert_close(even["damping"], torch.full((count,), 24 * 0.02).double())  # c_0 is of 24 frames per s
    torch.testing.assert_close(even["density"], torch.full((count,), np.exp(2.5 * np.tanh(9 / 2.5))).double())
    units[4], log3 = torch.tensor([1.0, 1.0, -1.0]), np.log(3)
    one = told(units)
    others = torch.arange(count) != 4
    assert float(one["stiffness"][4]) == pytest.approx(np.e) and (one["stiffness"][others] - 1).abs().max() < 1e-12
    assert float(one["damping"][4]) == pytest.approx(24 * 0.02 / np.e)
    thrice = told(torch.full_like(units, log3))["stiffness"]
    torch.testing.assert_close(thrice, torch.full((count,), 3.0).double())


@torch.no_grad()
def test_kernels_have_the_material_of_their_units() -> None:
    model = neural_model()
    known, scene = model.material(0), model.scenes[0]
    free = scene.simulated & ~scene.pinned
    unit = model.units_of_kernels(0)[model.predicted_levels[-1] - 1]
    for name in ("stiffness", "density", "damping"):
        values = known[name].values
        assert torch.equal(torch.isfinite(values), free) and (values[free] > 0).all()
        for u in unit[free].unique():
            assert len(values[free & (unit == u)].unique()) == 1


def test_every_model_of_it_can_be_made_stiffer() -> None:
    """Four times the stiffness swings twice as fast; models without a material cannot be adjusted."""
    model = neural_model()
    silence(model)
    live, rest = scene_dynamics(model), model.scenes[0].means
    assert isinstance(live, Adjustable) and not isinstance(scene_dynamics(make_model(model.scenes[0])), Adjustable)
    period = model.template.slowest_period(0, *_material_of(model))
    live.adjust(4.0, 1.0)
    stiffer = live.model.template.slowest_period(0, *_material_of(live.model))
    assert stiffer == pytest.approx(period / 2, rel=0.1)  # the decoders read it, too
    assert model.template.slowest_period(0, *_material_of(model)) == period  # predictions of the run stay
    live.adjust(1.0, 1.0)  # over the beginning, not over the last
    assert live.model.template.slowest_period(0, *_material_of(live.model)) == pytest.approx(period, rel=1e-6)
    assert torch.isfinite(live.rollout(SimState(rest, 0.99 * rest), 3).positions).all()


@pytest.mark.parametrize("given", [Damping(0.02, 1e-6), Damping(0.0, 0.02)])
@torch.no_grad()
def test_every_model_of_it_can_be_damped(given: Damping) -> None:
    """By its drag; where it has none, by its viscosity."""
    model = neural_model(template=partial(NEURAL["template"], damping=given))
    live = scene_dynamics(model)

    def damping() -> torch.Tensor:
        return live.model.template.matrices(0, *_material_of(live.model), 1 / 24).damping.trace()

    before = damping()
    live.adjust(1.0, 4.0)
    assert float(damping() / before) > 2
    live.adjust(1.0, 1.0)  # over the beginning, not over the last
    torch.testing.assert_close(damping(), before)


def _material_of(model):
    units = model.units(model.batch((0,)))[-1][-1]
    return units.log_density, units.attributes
