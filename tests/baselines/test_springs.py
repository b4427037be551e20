"""The net of springs: compiled against plain torch in float64, energy, momentum, pins, analytic frequency."""

from __future__ import annotations

import math

import pytest
import torch

from gausim.baselines.spring_gaus.springs import Net, forces, move, move_plain


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


def test_every_pair_is_one_spring_to_a_near_anchor() -> None:
    net, s = net_and_state()
    pairs = set(zip(net.first.tolist(), net.second.tolist(), strict=True))
    assert len(pairs) == len(net.first) and bool((net.first < net.second).all())
    for a in range(len(s["x"])):
        assert net.first[net.starts[a] : net.starts[a + 1]].eq(a).all()
    assert int(net.rank.max()) < net.reach == 20
    held = s["free"][:, 0] == 0
    assert not bool((held[net.first] & held[net.second]).any())


def test_attenuation_spares_the_nearest_and_ends_at_the_farthest() -> None:
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


def test_force_is_the_negative_slope_of_the_energy() -> None:
    net, state = net_and_state()
    x = state["x"].clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy_of(net, x, state["stiffness"]), x)
    none = torch.zeros_like(state["drag"])
    torch.testing.assert_close(forces(net, state["x"], state["v"], state["stiffness"], none), -slope)


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
