"""The compiled operations of a step against their torch forms, values and gradients; constants shared by steps."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gausim.core import SimState
from gausim.kernels.compiled import fits, torch_only
from gausim.models.step import features, recursion
from gausim.models.step.recursion import Inheritance, Solved, Units
from gausim.models.template.elastic import ElasticTemplate
from gausim.ops import aggregation
from gausim.ops.deformation import bounded_deformation, gradient_from_output, polar_rotation

NAMES = ("positions", "deformation_gradients", "rotations", "momentum")


def _random(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _compare(function, inputs: list[Tensor], *, tolerance: float = 2e-6) -> None:
    """Outputs and gradients in float32, compiled, against float64 by torch, relative to their norms."""
    found = []
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype).requires_grad_() for x in inputs]
        assert fits(*leaves) is (dtype is torch.float32)
        outputs = function(*leaves)
        loss = sum((o * _random(*o.shape, seed=i).to(dtype)).sum() for i, o in enumerate(outputs))
        found.append([*outputs, *torch.autograd.grad(loss, leaves, materialize_grads=True)])
    assert sum(bool(b.any()) for b in found[1]) > 0.7 * len(found[1])
    for number, (a, b) in enumerate(zip(*found, strict=True)):
        assert a.dtype is torch.float32
        assert float((a - b).detach().norm()) <= tolerance * float(b.detach().norm()), number


def test_float32_on_the_cpu_is_what_compiled_operations_take() -> None:
    x = torch.zeros(2)
    assert fits(x) and not fits(x, x.double()) and not fits(x.to("meta"))
    with torch_only():
        assert not fits(x)
    assert fits(x)


def test_weighted_sum() -> None:
    index = torch.tensor([2, 0, 2, 3, 3, 3])
    _compare(
        lambda values, weights: (aggregation.weighted_sum(values, weights, index, 5),),
        [_random(6, 3, seed=1), _random(6, seed=2)],
    )


@pytest.mark.parametrize("conserve", [False, True])
def test_gradient_from_output(conserve) -> None:
    output = _random(40, 11, seed=1)
    output[::3, 8:] *= 8  # beyond the bound of the stretch
    assert bool((output[:, 8:].abs() > 5).any())
    _compare(lambda x: gradient_from_output(x, conserve_mass=conserve), [output])


@pytest.mark.parametrize("unit", [False, True])
def test_bounded_deformation(unit) -> None:
    gradient = torch.eye(3) + 0.4 * _random(60, 3, 3, seed=1)
    assert 0 < int((torch.linalg.det(gradient) < 0.2).sum()) < 30
    _compare(lambda x: (bounded_deformation(x, 0.2, unit=unit),), [gradient])


def test_polar_rotation() -> None:
    gradient = torch.eye(3) + 0.25 * _random(50, 3, 3, seed=1)
    gradient = gradient[torch.linalg.det(gradient) > 0.1]
    assert float((polar_rotation(gradient.float()) - polar_rotation(gradient)).abs().max()) < 2e-6


def _parents(count: int) -> list[Tensor]:
    return [*(_random(count, 3, seed=20 + i) for i in range(5)), *(_random(count, 3, 3, seed=30 + i) for i in range(2))]


@pytest.mark.parametrize("rest_inputs", [False, True])
@pytest.mark.parametrize("angle", ["cos_sin", "inner"])
@pytest.mark.parametrize("coarse", [False, True])
def test_network_inputs(rest_inputs, angle, coarse) -> None:
    index = torch.tensor([1, 0, 1, 2, 2, 1, 0])
    edges = torch.tensor([[3, 5, 0, 6, 4, 1, 2, 0, 5], [0, 0, 1, 2, 3, 4, 4, 6, 6]])
    size, dt = _random(7, 1, seed=1).abs() + 1, torch.full((7, 1), 0.05, dtype=torch.float64)
    gravity, options = _random(3, seed=2), features.FeatureOptions(angle, rest_inputs, coarse)

    def inputs(*x: Tensor) -> tuple[Tensor, ...]:
        own = Units(x[0], x[1], x[2], x[4].exp(), x[4], x[5])
        above = Solved(*x[6:12], torch.eye(3).to(x[0]).expand(3, 3, 3), index)
        constants = (c.to(x[0]) for c in (size, dt, gravity))
        return features.network_inputs(own, x[3], above, edges, *constants, options, coarse=coarse)

    units = [_random(7, 3, seed=10 + i) for i in range(4)]
    units[1][3] = units[1][5]  # an edge of length zero
    _compare(inputs, [*units, _random(7, seed=14), _random(7, 2, seed=15), *_parents(3)[:6]])


def test_advance() -> None:
    index = torch.tensor([1, 0, 1, 2, 2, 1, 0])

    def advance(*x: Tensor) -> tuple[Tensor, ...]:
        return recursion.advance(*x[:3], Solved(x[3], x[3], x[3], x[3], *x[4:7], index))

    own = [_random(7, 3, 3, seed=1), _random(7, 3, 3, seed=2), _random(7, 3, seed=3)]
    _compare(advance, [*own, *_parents(3)[3:]])


@pytest.mark.parametrize("moving", [False, True])
def test_inherit(moving) -> None:
    kernels = Inheritance(
        _random(9, 3, seed=1), torch.tensor([0, 2, -1, 1, 1, -1, 0, 2, 2]), torch.tensor([0, 1, 3]), 5
    )

    def inherit(*x: Tensor) -> tuple[Tensor, ...]:
        own = Inheritance(kernels.rest.to(x[0]), kernels.unit, kernels.rows, kernels.padded)
        finest = Solved(x[0], x[0], x[0], x[1], x[0], x[2], x[3], torch.zeros(3, dtype=torch.int64))
        return recursion.inherit(finest, x[4] if moving else None, own)

    template = torch.eye(3) + 0.1 * _random(3, 3, 3, seed=6)
    tensors = [_random(3, 3, seed=2), _random(3, 3, seed=3), _random(3, 3, 3, seed=4), _random(3, 3, 3, seed=5)]
    _compare(inherit, [*tensors, template] if moving else tensors)


def _rollout(model, batch, state: SimState, *, share: bool, steps: int = 3) -> list[Tensor]:
    prepared, made = model.prepare(batch) if share else None, []
    for _ in range(steps):
        made.append(model.step(batch, state, None, prepared))
        state = SimState(made[-1].positions, state.positions)
    return [getattr(step, name) for step in made for name in NAMES]


OPTIONS = [
    {},
    {"predicted_levels": (0,), "graph_radii": (0.3,)},
    {"rest_inputs": True, "edges": "rest", "template": partial(ElasticTemplate, modes=5, neighbours=6)},
    {"coarse_inputs": True, "angle": "inner", "conserve_mass": False, "gravity": (0.0, 1.0, -3.0)},
]


@pytest.mark.parametrize("options", OPTIONS, ids=["paper", "no_hierarchy", "elastic", "other_readings"])
def test_compiled_rollout_equals_the_torch_rollout(make_scene, make_model, make_state, join_states, options) -> None:
    scenes = [make_scene(70), make_scene(55, seed=1)]
    model = make_model(scenes, output_scale=0.5, **options)
    batch = model.batch((0, 1, 0))
    state = join_states([make_state(scenes[i], seed=j) for j, i in enumerate((0, 1, 0))])
    previous = state.previous.clone().requires_grad_()
    leaves = [previous, *(p for p in model.parameters() if p.requires_grad)]
    found = []
    for compiled in (True, False):
        with torch_only() if not compiled else torch.enable_grad():
            outputs = _rollout(model, batch, SimState(state.positions, previous), share=True)
            loss = sum((o * _random(*o.shape, seed=i).float()).sum() for i, o in enumerate(outputs))
            found.append([outputs, torch.autograd.grad(loss, leaves, allow_unused=True)])
    (outputs, grads), (expected, expected_grads) = found
    for a, b in zip(outputs, expected, strict=True):
        assert torch.allclose(a, b, atol=2e-5, rtol=2e-4)
    used = 0
    for a, b in zip(grads, expected_grads, strict=True):
        assert (a is None) == (b is None)
        if a is not None and float(b.norm()) > 0:
            used += 1
            assert float((a - b).norm() / b.norm()) < 2e-3
    assert used > 5


@pytest.mark.parametrize("options", OPTIONS, ids=["paper", "no_hierarchy", "elastic", "other_readings"])
def test_steps_that_share_constants_equal_steps_of_their_own(make_scene, make_model, make_state, options) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5, **options)
    batch, state = model.batch((0,)), make_state(scene)
    results = []
    for share in (True, False):
        model.zero_grad()
        outputs = _rollout(model, batch, state, share=share)
        sum(o.square().sum() for o in outputs).backward()
        results.append((outputs, [p.grad.clone() for p in model.parameters() if p.grad is not None]))
    for a, b in zip(results[0][0], results[1][0], strict=True):
        assert torch.equal(a, b)
    for a, b in zip(results[0][1], results[1][1], strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-5 * float(b.abs().max()))


def test_constants_serve_a_step_that_is_computed_once_more_in_the_backward_pass(
    make_scene, make_model, make_state
) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5)
    batch, state = model.batch((0,)), make_state(scene)
    results = []
    for repeat in (False, True):
        model.zero_grad()
        prepared, now, before = model.prepare(batch), state.positions, state.previous

        def advance(x, y, prepared=prepared):
            return model.step(batch, SimState(x, y), None, prepared).positions

        for _ in range(3):
            following = checkpoint(advance, now, before, use_reentrant=False) if repeat else advance(now, before)
            now, before = following, now
        now.square().sum().backward()
        results.append([now, *(p.grad for p in model.parameters() if p.grad is not None)])
    assert len(results[0]) == len(results[1]) > 5
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_constants_of_another_batch_or_without_gradients_are_refused(make_scene, make_model, make_state) -> None:
    scene = make_scene(70)
    model, state = make_model([scene, scene]), make_state(scene)
    with pytest.raises(ValueError, match="another batch"):
        model.step(model.batch((0,)), state, None, model.prepare(model.batch((1,))))
    with torch.no_grad():
        prepared = model.prepare(model.batch((0,)))
        model.step(model.batch((0,)), state, None, prepared)
    with pytest.raises(ValueError, match="without gradients"):
        model.step(model.batch((0,)), state, None, prepared)


def test_compiled_rollout_repeats_bit_for_bit(make_scene, make_model, make_state) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5)
    results = []
    for _ in range(2):
        model.zero_grad()
        outputs = _rollout(model, model.batch((0,)), make_state(scene), share=True)
        sum(o.square().sum() for o in outputs).backward()
        results.append([*outputs, *(p.grad for p in model.parameters() if p.grad is not None)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
