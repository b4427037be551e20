"""Bodies that move as a whole, in hands, and onto a floor."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.bodies import NEURAL, make_model

from gausim.core import Floor, GaussianScene, HandPath, SimState, Surroundings
from gausim.models.initial_state import FreeInitialStates, ModalInitialStates
from gausim.models.reference.floor import COMPLIANCE, Contact, _projected_gradients, _softer, _solved
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.predictor import with_floor_columns
from gausim.models.template.solid import SolidSettings
from gausim.ops.rotation import cross_matrix, rotation_of

TURN = torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64)
FLOOR = Floor((0.0, 0.0, -0.3), (0.0, 0.0, 1.0), friction=0.4, restitution=0.0)
FALL = -9.0


def _block(count: int = 220, **surroundings) -> GaussianScene:
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([1.2, 0.8, 0.6], dtype=torch.float64)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) * size
    scene = GaussianScene.create(
        means=means, log_scales=torch.full_like(means, -3), quats=torch.eye(4).double()[:1].repeat(count, 1),
        opacity_logits=torch.zeros(count).double(), sh=torch.zeros(count, 1, 3).double(),
    )  # fmt: skip
    return replace(scene, surroundings=Surroundings(**surroundings))


def _frozen(scene: GaussianScene, **options):
    return make_model(scene, **(NEURAL | options)).double().eval().requires_grad_(False)


def _thrown(scene: GaussianScene, speed: float = 1.0) -> SimState:
    """It translates, spins and deforms."""
    x, velocity = scene.means, torch.tensor([0.02, -0.01, 0.015]).double()
    spin = torch.linalg.cross(torch.tensor([0.05, 0.1, -0.02]).double().expand_as(x), x - x.mean(0))
    stretch = 0.01 * (x - x.mean(0)) * torch.tensor([1.0, -1.0, 0.0]).double()
    return SimState(x, x - speed * (velocity + spin - stretch))


def _fractions(model) -> torch.Tensor:
    """Mass of every kernel over that of the body."""
    mass, _ = model.masses(model.batch((0,)))
    return mass / mass.sum()


def _steps(model, state: SimState, count: int) -> list[SimState]:
    batch = model.batch((0,))
    prepared, states = model.prepare(batch), [state]
    for _ in range(count):
        made = model.step(batch, states[-1], prepared=prepared)
        states.append(made.state or SimState(made.positions, states[-1].positions))
    return states


def _momenta(state: SimState, mass: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    now, before = mass @ state.positions, mass @ state.previous
    arms = torch.linalg.cross(state.previous - before, state.positions - now)
    return now - before, mass @ arms


def test_a_free_body_keeps_momenta_and_may_have_more_modes() -> None:
    scene = _block(free=True)
    model = _frozen(scene)
    mass, states = _fractions(model), _steps(model, _thrown(scene), 60)
    torch.testing.assert_close(_momenta(states[-1], mass), _momenta(states[0], mass), atol=1e-11, rtol=0)
    away = (states[-1].positions - mass @ states[-1].positions).norm(dim=1).max()
    assert away < 1.2 * (scene.means - scene.means.mean(0)).norm(dim=1).max()
    held = replace(_block(), pinned=torch.arange(220) < 20)
    template = partial(NEURAL["template"], solid=SolidSettings(0.2, 0.0))
    model = make_model([_block(free=True), held], **(NEURAL | {"template": template}))
    assert [model.modal_projection(i).shape[-1] for i in (0, 1)] == [18, 9]


def test_a_rigid_spin_about_a_principal_axis_goes_on() -> None:
    """A body that is not deformed, about an axis of symmetry: the centrifugal load deforms it a little, no more."""
    scene = _block(free=True)
    model, x = _frozen(scene), scene.means
    mass = _fractions(model)
    centre = mass @ x
    spread = (x - centre).mT @ (mass[:, None] * (x - centre))
    axis = torch.linalg.eigh(spread)[1][:, 0]  # of the largest moment of inertia
    spin = rotation_of(0.02 * axis)
    last = _steps(model, SimState(x, (x - centre) @ spin + centre), 50)[-1]
    turned = (x - centre) @ torch.linalg.matrix_power(spin, 50).mT + centre
    assert (last.positions - turned).norm(dim=1).max() < 0.02 * scene.diagonal


@pytest.mark.parametrize("sees_floor", [False, True])
def test_a_turned_and_moved_scene_gives_turned_and_moved_motion(sees_floor: bool) -> None:
    scene, turn, shift = _block(free=True, gravity=(0.0, 0.0, FALL), floor=FLOOR), rotation_of(TURN), TURN.flip(0)
    normal, point = (turn @ torch.tensor(x).double() for x in (FLOOR.normal, FLOOR.point))
    floor = replace(FLOOR, normal=tuple(normal.tolist()), point=tuple((point + shift).tolist()))
    gravity = tuple((turn @ torch.tensor([0.0, 0.0, FALL]).double()).tolist())
    around = Surroundings(free=True, gravity=gravity, floor=floor)
    other = replace(scene, means=scene.means @ turn.mT + shift, surroundings=around)
    model, moved = _frozen(scene, floor=sees_floor), _frozen(other, floor=sees_floor)
    moved.load_state_dict(model.state_dict())
    state = _thrown(scene)
    alike = SimState(*(x @ turn.mT + shift for x in (state.positions, state.previous)))
    found, expected = _steps(moved, alike, 15), _steps(model, state, 15)
    for frame, most in ((6, 1e-4), (9, 2e-4)):  # in the air, and after the impact: motion magnifies rounding
        far = (found[frame].positions - expected[frame].positions @ turn.mT - shift).abs().max()
        assert far < most * scene.diagonal


def test_a_fall_is_a_parabola_until_the_floor_which_nothing_enters() -> None:
    scene = _block(free=True, gravity=(0.0, 0.0, FALL), floor=FLOOR)
    model = _frozen(scene)
    states = _steps(model, SimState(scene.means, scene.means), 60)
    heights = torch.stack([_fractions(model) @ s.positions[:, 2] for s in states])
    frame = torch.arange(5).double()
    torch.testing.assert_close(heights[:5], heights[0] + FALL / 24**2 * frame * (frame + 1) / 2)
    lowest = min(float(FLOOR.height(s.positions).min()) for s in states)
    assert -1e-3 * scene.diagonal < lowest < 0.01 * scene.diagonal
    assert heights[45:].std() < 0.02 * scene.diagonal  # it has come to rest


def test_units_see_how_near_the_floor_is_and_where(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, turn = _block(free=True, floor=FLOOR), rotation_of(TURN)
    model = _frozen(scene, floor=True)
    batch, seen = model.batch((0,)), []
    forward = model.predictor.network.forward
    monkeypatch.setattr(model.predictor.network, "forward", lambda n, *rest: (seen.append(n), forward(n, *rest))[1])
    prepared = model.prepare(batch)
    still = len(seen)
    middle = scene.means.mean(0)
    turned = (scene.means - middle) @ turn.mT + middle
    model.step(batch, SimState(turned, turned), prepared=prepared)
    height = FLOOR.height(prepared.mean(turned)) / model.hierarchies[0].diagonal
    near = prepared.per_level((1 - height[:, None] / 0.2).clamp(0, 1).square())
    assert float(near[-1].max()) > 0.1 and float(near[-1].min()) == 0
    normal = torch.from_numpy(model.body_axes[0]) @ turn.mT @ torch.tensor(FLOOR.normal).double()
    for nodes, p in zip(seen[still:], near, strict=True):
        # The body's rotation is that of its best fit.
        torch.testing.assert_close(nodes[:, -4:], torch.cat((p, p * normal), 1), atol=1e-6, rtol=1e-5)
    assert all(bool((nodes[:, -4:] == 0).all()) for nodes in seen[:still])  # at rest there are no surroundings


def test_models_of_scenes_without_a_floor_are_as_before_and_networks_fit_both_ways() -> None:
    bare, floored = _block(free=True), _block(free=True, floor=FLOOR)
    before, model = _frozen(bare), _frozen(bare, floor=True)
    states = (m.state_dict().values() for m in (before, model))
    assert all(torch.equal(x, y) for x, y in zip(*states, strict=True))
    both = make_model([bare, floored], **NEURAL, floor=True).double()
    wide, narrow = ({n: x for n, x in m.state_dict().items() if n.startswith("predictor")} for m in (both, model))
    model.load_state_dict(with_floor_columns(wide, narrow), strict=False)
    state = _thrown(bare)
    model.load_state_dict({n: x for n, x in both.state_dict().items() if n in model.state_dict()
                           and not n.startswith("predictor")}, strict=False)  # fmt: skip
    # Without a floor the columns of the floor read zeros.
    torch.testing.assert_close(*(m.step(m.batch((0,)), state).positions for m in (model, both)))
    again = with_floor_columns(narrow, wide)
    name = next(n for n in wide if n.endswith("node_encoder.0.weight"))
    assert again[name].shape == wide[name].shape and bool((again[name][:, -4:] == 0).all())
    assert torch.equal(again[name][:, :-4], narrow[name])


def test_friction_stops_what_slides_and_without_it_nothing_does() -> None:
    speeds = []
    for friction in (0.0, 0.6):
        floor = replace(FLOOR, point=(0.0, 0.0, 0.0), friction=friction)
        scene = _block(free=True, gravity=(0.0, 0.0, FALL), floor=floor)
        model, push = _frozen(scene), torch.tensor([0.01, 0.0, 0.0]).double()
        last = _steps(model, SimState(scene.means, scene.means - push), 28)[-1]
        speeds.append(float(_fractions(model) @ (last.positions - last.previous)[:, 0]))
    assert speeds[0] == pytest.approx(0.01, rel=0.05)
    assert abs(speeds[1]) < 1e-3


def test_impulses_obey_the_laws_of_contact_and_their_equations_agree() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(12, 14, generator=generator, dtype=torch.float64)
    w, b = root @ root.mT / 14 + 0.1 * torch.eye(12), torch.randn(12, generator=generator, dtype=torch.float64)
    p = smooth = torch.zeros(12).double()
    for _ in range(100):
        p, smooth = _projected_gradients(w, b, 0.5, p), _projected_gradients(w, b, 0.0, smooth)
    found, gap = p.view(-1, 3), (w @ p + b).view(-1, 3)
    size = found[:, 1:].norm(dim=1)
    assert (found[:, 0] >= 0).all() and (size <= 0.5 * found[:, 0] + 1e-9).all()
    pressing = found[:, 0] > 1e-9
    sliding = pressing & (size > 0.4999 * found[:, 0])
    assert pressing.any() and sliding.any()
    sticking = gap[pressing & ~sliding]
    torch.testing.assert_close(sticking, torch.zeros_like(sticking), atol=1e-7, rtol=0)
    # Without friction the equations of the pressing points give the same impulses.
    pressing = smooth.view(-1, 3)[:, 0] > 1e-9
    equal = _solved(w, b, pressing, pressing, torch.zeros(4, 2).double())
    torch.testing.assert_close(equal, smooth, atol=1e-7, rtol=0)


def test_loss_gradients_of_many_near_contacts_tell_of_their_sum_only() -> None:
    corners = torch.rand(10, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    corners = torch.cat((corners[:, :2] - corners[:, :2].mean(0), torch.zeros(10, 1).double()), 1)
    rows = torch.cat((torch.eye(3).double().expand(10, 3, 3), -cross_matrix(corners)), -1)
    body = rows[:, [2, 0, 1]].flatten(0, 1)  # a rigid plate: along the normal and two tangents, by six coordinates
    spread = _softer(body @ body.mT, COMPLIANCE)
    contact = Contact(FLOOR, torch.tensor(5.0).double(), torch.tensor(0.0).double(), 1.0)
    wanted, guess, pressing = -body[:, 2], torch.zeros(30).double(), torch.ones(10, dtype=torch.bool)
    for _ in range(20):
        guess = contact._impulses(spread, wanted, guess)[1]
    found = torch.autograd.functional.jacobian(lambda b: contact._impulses(spread, b, guess)[0], wanted)
    still = torch.zeros(10, 2).double()
    exact = torch.autograd.functional.jacobian(lambda b: _solved(spread, b, pressing, ~pressing, still), wanted)
    assert found.abs().max() < 0.03 * exact.abs().max()  # how the points share an impulse
    whole, right = body.mT @ found @ body, body.mT @ exact @ body  # what becomes of the plate
    assert (whole - right).norm() < 0.1 * right.norm()


def test_loss_gradients_flow_through_an_impact() -> None:
    scene = _block(free=True, gravity=(0.0, 0.0, FALL), floor=replace(FLOOR, friction=None, restitution=None))
    model = make_model(scene, **NEURAL).double().eval()
    surroundings = model.surroundings[0]
    states = _steps(model, SimState(scene.means, scene.means), 12)
    states[-1].positions.square().sum().backward()
    for parameter in (surroundings.friction, surroundings.restitution, model.attributes[0]):
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all() and parameter.grad.abs().max() > 0


def _bar(hands: bool = True) -> GaussianScene:
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(300, 3, generator=generator, dtype=torch.float64) * torch.tensor([2.0, 0.4, 0.3])
    scene = replace(_block(300), means=means)
    hand = torch.where(means[:, 0] < 0.25, 0, torch.where(means[:, 0] > 1.75, 1, -1))
    return replace(scene, pinned=hand >= 0, hand=hand)


def _path(move) -> HandPath:
    """Hands at x = 0.1 and 1.9, moved from frame 1 on by a function of frame and points."""
    corners = torch.tensor([[0.0, 0.1, 0.0], [0.0, -0.1, 0.1], [0.0, 0.0, -0.1]]).double()
    points = torch.cat([corners + torch.tensor([x, 0.2, 0.15]) for x in (0.1, 1.9)])
    return HandPath.of(torch.stack([move(f, points) for f in range(41)]), torch.tensor([0, 0, 0, 1, 1, 1]))


def test_hands_that_move_together_carry_the_body_rigidly() -> None:
    scene = _bar()
    model, turn, shift = _frozen(scene), 0.5 * TURN, torch.tensor([0.3, 0.1, -0.2]).double()

    def move(frame: int, points: torch.Tensor) -> torch.Tensor:
        part = min(frame / 200, 1.0)  # slowly
        return points @ rotation_of(part * turn).mT + part * shift

    path = _path(move)
    made = SceneDynamics(model).rollout(SimState(scene.means, scene.means), 40, hands=path.pose)
    expected = move(40, scene.means)
    assert (made.positions[-1] - expected).norm(dim=1).max() < 0.01 * scene.diagonal
    torch.testing.assert_close(made.positions[-1][scene.pinned], expected[scene.pinned], atol=1e-5, rtol=0)
    rotation = made.rotations[-1][made.unit_of_kernel[scene.pinned]]
    torch.testing.assert_close(rotation, rotation_of(0.2 * turn).expand_as(rotation), atol=1e-3, rtol=0)


def test_a_bar_pulled_apart_comes_to_rest_stretched_evenly_and_thinner() -> None:
    scene = _bar()
    model = _frozen(scene, template=partial(NEURAL["template"], solid=SolidSettings(0.12, 0.0, free_modes=1)))
    apart = torch.tensor([0.2, 0.0, 0.0]).double()
    path = _path(lambda f, x: x + min(f / 20, 1.0) * apart * (x[:, :1] > 1))
    made = SceneDynamics(model).rollout(SimState(scene.means, scene.means), 120, hands=path.pose).positions[-1]
    free = ~scene.pinned
    x = scene.means[free]
    stretched = torch.stack((torch.ones(len(x)).double(), x[:, 0]), 1)
    slope = torch.linalg.lstsq(stretched, (made[free] - x)[:, :1]).solution[1]
    assert float(slope) == pytest.approx(0.2 / 1.5, rel=0.1)
    assert (made[free] - x)[:, 0].std() > 0.04 and (made - scene.means)[free].norm(dim=1).max() < 0.25


@pytest.mark.parametrize("kind", [FreeInitialStates, ModalInitialStates])
def test_a_free_body_begins_where_its_parameter_says(kind) -> None:
    scene = _block(free=True)
    states = kind(_frozen(scene), (0,)).double()
    place, velocity = torch.tensor([0.5, 0.0, 1.0]).double(), torch.tensor([0.0, 0.1, -0.2]).double()
    states.begin(0, place, velocity)
    found = states.state(0)
    torch.testing.assert_close(found.positions, scene.means + place)
    torch.testing.assert_close(found.positions - found.previous, velocity.expand_as(scene.means), atol=1e-6, rtol=0)
    found.positions.square().sum().backward()
    assert states.parameter(0).grad.flatten()[-12:-6].abs().min() > 0
