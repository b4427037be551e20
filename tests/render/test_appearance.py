"""Covariances and colours of deformed kernels: the compiled form against torch in float64."""

from __future__ import annotations

import pytest
import torch

from gausim.ops.covariance import transport_covariance
from gausim.ops.deformation import polar_rotation
from gausim.render.cpu.appearance import deformed_appearance
from gausim.render.draw import SceneAppearance, view_colors

KERNELS, UNITS, STATES = 37, 5, 3  # not a multiple of the sixteen kernels of a block
NAMES = ("positions", "gradients", "rotations", "covars", "sh")


def case(degree: int) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(degree)
    deformation_gradients = torch.eye(3) + 0.3 * torch.randn(STATES, UNITS, 3, 3, generator=g)
    root = torch.randn(KERNELS, 3, 3, generator=g)
    inputs = {
        "positions": torch.randn(STATES, KERNELS, 3, generator=g),
        "gradients": deformation_gradients,
        "rotations": polar_rotation(deformation_gradients),
        "covars": root @ root.mT,
        "sh": torch.randn(KERNELS, (degree + 1) ** 2, 3, generator=g),
    }
    return inputs, torch.randint(0, UNITS, (KERNELS,), generator=g), 4 * torch.randn(2, 3, generator=g)


def in_torch(
    degree: int, inputs: dict[str, torch.Tensor], unit: torch.Tensor, centers: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    rest = inputs["covars"].expand(STATES, -1, -1, -1)
    look = SceneAppearance(inputs["covars"], torch.ones(KERNELS), inputs["sh"], degree, index=None)
    colors = view_colors(look, inputs["positions"], inputs["rotations"], unit, centers)
    return transport_covariance(rest, inputs["gradients"].index_select(1, unit)), colors


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_and_gradients_are_those_of_torch_in_float64(degree: int) -> None:
    inputs, unit, centers = case(degree)
    found = []
    for dtype in (torch.float32, torch.float64):
        leaves = {name: value.to(dtype).requires_grad_() for name, value in inputs.items()}
        if dtype == torch.float32:
            outputs = deformed_appearance(
                *(leaves[name] for name in NAMES[:3]), unit, leaves["covars"], leaves["sh"], centers
            )
        else:
            outputs = in_torch(degree, leaves, unit, centers.double())
        g = torch.Generator().manual_seed(9)
        weights = [torch.randn(o.shape, generator=g).to(dtype) for o in outputs]
        grads = torch.autograd.grad(
            sum((o * w).sum() for o, w in zip(outputs, weights, strict=True)), list(leaves.values()), allow_unused=True
        )
        found.append([*outputs, *grads])
    for name, value, truth in zip(("covariances", "colours", *NAMES), *found, strict=True):
        if truth is None:  # degree 0 does not turn
            assert value is None or not value.any(), name
            continue
        assert (value.double() - truth).norm() < 2e-6 * truth.norm() + 1e-9, name


def test_the_number_of_threads_changes_nothing() -> None:
    inputs, unit, centers = case(2)
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
            outputs = deformed_appearance(
                *(leaves[name] for name in NAMES[:3]), unit, leaves["covars"], leaves["sh"], centers
            )
            found.append([*outputs, *torch.autograd.grad(sum(o.sum() for o in outputs), list(leaves.values()))])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
