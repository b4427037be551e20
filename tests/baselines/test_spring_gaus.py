"""Spring-Gaus: its net of springs, anchors, and known materials that are found again."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from helpers.fitted_methods import recorded, rolled
from helpers.toy_object import toy_scene

from gausim.baselines.deformation_field import DeformationField
from gausim.baselines.spring_gaus.anchors import Anchors
from gausim.baselines.spring_gaus.spring_mass import SpringMass, slowest_vibration
from gausim.baselines.spring_gaus.springs import Net, move, move_plain
from gausim.core import ConfigError, DivergenceError, Floor, Surroundings
from gausim.ops.rotation import quaternion_to_matrix


def net_and_state(seed: int = 0, *, count: int = 24, neighbours: int = 20) -> tuple[Net, dict[str, torch.Tensor]]:
    g = torch.Generator().manual_seed(seed)
    rest = torch.rand(count, 3, generator=g, dtype=torch.float64)
    pinned = rest[:, 2] < 0.2
    net = Net.of(rest, pinned, neighbours)
    free = (~pinned).double()[:, None]
    edges = len(net.length)
    return net, {
        "x": rest + 0.05 * torch.randn(count, 3, generator=g, dtype=torch.float64) * free,
        "v": 0.1 * torch.randn(count, 3, generator=g, dtype=torch.float64) * free,
        "stiffness": 0.5 + torch.rand(edges, generator=g, dtype=torch.float64),
        "drag": 0.1 * torch.rand(edges, generator=g, dtype=torch.float64),
        "free": free,
    }


def test_pairs_are_springs_to_near_anchors_that_fade() -> None:
    net, s = net_and_state()
    pairs = set(zip(net.first.tolist(), net.second.tolist(), strict=True))
    assert len(pairs) == len(net.first) and bool((net.first < net.second).all())
    for a in range(len(s["x"])):
        assert net.first[net.starts[a] : net.starts[a + 1]].eq(a).all()
    assert int(net.rank.max()) < net.reach == 20
    held = s["free"][:, 0] == 0
    assert not bool((held[net.first] & held[net.second]).any())
    net, _ = net_and_state(count=60, neighbours=40)
    fade = net.attenuation(torch.tensor(0.0))
    assert bool((fade[net.rank < 16] == 1).all())
    last = net.rank == 39  # softplus(0) = log 2, so 2 - exp(log 2) = 0 at the farthest
    torch.testing.assert_close(fade[last], torch.zeros(int(last.sum())), atol=1e-6, rtol=0)
    half = net.rank == 27
    torch.testing.assert_close(fade[half], torch.full((int(half.sum()),), 2 - math.sqrt(2)))


def test_compiled_motion_equals_plain_torch_with_all_gradients() -> None:
    net, state = net_and_state()
    names, results = ("x", "v", "stiffness", "drag"), []
    weight = torch.randn(2, *state["x"].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for function in (move, move_plain):
        leaves = [state[n].clone().requires_grad_() for n in names]
        x, v = function(net, *leaves, state["free"], 7)
        ((x * weight[0]).sum() + (v * weight[1]).sum()).backward()
        results.append([x, v, *(leaf.grad for leaf in leaves)])
    for name, ours, oracle in zip(("x", "v", *names), *results, strict=True):
        torch.testing.assert_close(ours, oracle, rtol=1e-9, atol=1e-11, msg=lambda m, n=name: f"{n}: {m}")


def energy_of(net: Net, x: torch.Tensor, stiffness: torch.Tensor) -> torch.Tensor:
    """The sum of kappa L_0^2 (2/5 (1 + |e|)^(5/2) - 2/3 (1 + |e|)^(3/2) + 4/15)."""
    e = ((x[net.second] - x[net.first]).norm(dim=1) / net.length - 1).abs()
    return (stiffness * net.length**2 * (0.4 * (1 + e) ** 2.5 - 2 / 3 * (1 + e) ** 1.5 + 4 / 15)).sum()


@pytest.mark.parametrize(("drag", "low", "high"), [(0.0, 0.999, 1.001), (0.05, 0.0, 0.9)])
def test_energy_stays_without_drag_and_falls_with_it(drag: float, low: float, high: float) -> None:
    net, state = net_and_state()
    x, v = state["x"], state["v"]

    def energy() -> float:
        return float(0.5 * v.square().sum() + energy_of(net, x, state["stiffness"]))

    before = energy()
    for _ in range(20):
        x, v = move(net, x, v, state["stiffness"], torch.full_like(state["drag"], drag), state["free"], 800)
    assert low * before < energy() < high * before


def test_momentum_is_kept_and_pins_hold() -> None:
    net, state = net_and_state()
    everything = torch.ones_like(state["free"])
    x, v = move(net, state["x"], state["v"], state["stiffness"], state["drag"], everything, 50)
    torch.testing.assert_close(v.sum(0), state["v"].sum(0))
    angular = [torch.linalg.cross(a, b).sum(0) for a, b in ((state["x"], state["v"]), (x, v))]
    torch.testing.assert_close(angular[1], angular[0], rtol=1e-3, atol=1e-4)  # exact up to the step's own order
    x, _ = move(net, state["x"], state["v"], state["stiffness"], state["drag"], state["free"], 50)
    held = state["free"][:, 0] == 0
    assert held.any() and torch.equal(x[held], state["x"][held])


def springs(**options: Any) -> SpringMass:
    options = {"anchors": 40, "neighbours": 24, "substeps": 20, "period": 8.0, **options}
    return SpringMass(**recorded(), **options)


def swaying(method: SpringMass, speed: float = 0.01) -> SpringMass:
    with torch.no_grad():
        for velocity in method.velocity:
            velocity[:, 0] = speed * method.anchors(0).rest[:, 2]
    return method


@pytest.mark.parametrize(("around", "text"), [
    ({"gravity": (0.0, 0.0, -9.8)}, "'gravity'"),
    ({"trains_gravity": True}, "'gravity' that is trained"),
    ({"free": True, "floor": Floor((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))}, "'free', a 'floor'"),
])  # fmt: skip
def test_surroundings_that_springs_do_not_know_are_refused(around: dict[str, Any], text: str) -> None:
    scene = replace(toy_scene(), surroundings=Surroundings(**around))
    with pytest.raises(ConfigError, match=rf"spring_mass: 'toy' has {text} in its dataset.json, .*model=gausim"):
        SpringMass(anchors=40, **recorded(toy_scene(), scene))


def test_no_baseline_keeps_pins_in_place_that_hands_move() -> None:
    scene = toy_scene()
    held = recorded(replace(scene, hand=torch.where(scene.pinned, 0, -1)))
    for method in (partial(SpringMass, anchors=40), DeformationField):
        with pytest.raises(ConfigError, match="'toy' has a 'grip' of hands"):
            method(**held)


def test_kernels_follow_an_affine_motion_with_its_gradient() -> None:
    scene = replace(toy_scene(), pinned=torch.zeros(36, dtype=torch.bool))
    anchors = Anchors.of(scene, 40)
    assert len(anchors.rest) == 36 and not bool(anchors.pinned.any())
    turn = quaternion_to_matrix(torch.tensor([1.0, 0.2, -0.1, 0.3]))
    wanted = turn @ torch.diag(torch.tensor([1.2, 0.9, 1.05]))
    deformation_gradients, rotations = anchors.deformation_gradients(anchors.rest @ (wanted - torch.eye(3)).T)
    error = (deformation_gradients - wanted).norm(dim=(1, 2)) / (wanted - torch.eye(3)).norm()
    assert float(error.max()) < 0.02  # the ridge shrinks it a little
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(36, 3, 3), atol=1e-5, rtol=0)
    shift = torch.tensor([0.1, -0.2, 0.3])
    moved = anchors.positions(shift.expand(len(anchors.rest), 3))
    torch.testing.assert_close(moved, scene.means + scene.diagonal * shift)


def test_held_kernels_and_pinned_anchors_never_move() -> None:
    scene = toy_scene()
    outside = torch.arange(36) == 35
    scene = replace(scene, simulated=~outside)
    method = SpringMass(**recorded(scene), anchors=40, neighbours=20, substeps=20)
    with torch.no_grad():
        method.velocity[0].normal_(std=0.02)
        states = rolled(method, 6)
    held, anchors = scene.pinned | outside, method.anchors(0)
    assert bool(anchors.pinned.any()) and not bool(anchors.pinned.all())
    for state in states:
        assert torch.equal(state.positions[held], scene.means[held])
        torch.testing.assert_close(state.deformation_gradients[held], torch.eye(3).expand(int(held.sum()), 3, 3))
        assert torch.equal(state.inner[0][anchors.pinned], anchors.rest[anchors.pinned])
    assert float((states[-1].positions - scene.means)[~held].norm(dim=1).min()) > 0


def test_the_slowest_vibration_has_the_period_that_was_asked_for() -> None:
    method = springs(period=8.0, damping=1e-6, substeps=60)
    kappa = method.springs(0)[0].detach()
    square = slowest_vibration(method._nets[0], method.anchors(0), kappa)
    assert 2 * math.pi / math.sqrt(square) == pytest.approx(8.0, rel=1e-4)
    with torch.no_grad():
        x = torch.stack([s.positions[:, 0].mean() for s in rolled(swaying(method, 1e-3), 24)])
    x = x - x[0]
    signs = (x[1:-1] * x[2:] < 0).nonzero().flatten().tolist()
    assert signs[0] in (2, 3, 4)  # back at rest after about half a period


def loss_of(method: SpringMass, targets: list[torch.Tensor]) -> torch.Tensor:
    states = rolled(method, len(targets) - 1)
    return torch.stack([(s.positions - t).square().mean() for s, t in zip(states, targets, strict=True)]).sum()


def fitted(method: SpringMass, parameters: torch.nn.ParameterList, targets: list[torch.Tensor], rate: float) -> float:
    optimizer = torch.optim.Adam(parameters.parameters(), lr=rate)
    for _ in range(40):
        optimizer.zero_grad()
        loss_of(method, targets).backward()
        optimizer.step()
    return float(parameters[0].detach().mean())


def test_a_known_damping_is_found_again_by_a_right_gradient() -> None:
    truth = swaying(springs(damping=0.5))
    with torch.no_grad():
        targets = [s.positions for s in rolled(truth, 8)]
    method = swaying(springs(damping=0.1))
    loss_of(method, targets).backward()
    slope, rest = method.damping[0].grad, method.damping[0].detach().clone()
    quotient = []
    with torch.no_grad():
        for step in (0.05, -0.05):  # of the common logarithm
            method.damping[0].copy_(rest + step)
            quotient.append(float(loss_of(method, targets)))
        method.damping[0].copy_(rest)
    assert slope is not None and slope < 0  # too little
    assert float(slope) == pytest.approx((quotient[0] - quotient[1]) / 0.1, rel=0.02)
    assert 10 ** abs(fitted(method, method.damping, targets, 0.05) - math.log10(0.5)) < 1.2


def test_stiff_springs_get_more_substeps_and_too_stiff_ones_a_message() -> None:
    method = springs()
    kappa, drag = (x.detach() for x in method.springs(0))
    assert method._count(0, kappa, drag) == 20
    count = method._count(0, 100 * kappa, drag)
    assert count > 20 and count >= math.sqrt(method._nets[0].stiffest(100 * kappa))
    with torch.no_grad():
        method.stiffness[0] += 6
        with pytest.raises(DivergenceError, match=r"'toy'.*substeps per frame.*model\.method\.substeps"):
            method.advance(method.begin(0))
