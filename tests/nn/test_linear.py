from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from gausim.nn.linear import SMALLEST, Linear, has_onednn


def _randn(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape)))


@pytest.mark.parametrize("bias", [True, False])
def test_large_layers_equal_the_base_class_in_values_and_gradients(bias: bool) -> None:
    layer = Linear(128, 96, bias=bias)
    plain = torch.nn.Linear(128, 96, bias=bias)
    plain.load_state_dict(layer.state_dict())
    rows = SMALLEST // (128 * 96) + 1
    for inputs in (_randn(rows, 128), _randn(rows, 256)[:, 64:192], _randn(1, 128).expand(rows, 128)):
        results = []
        for module in (layer, plain):
            leaf = inputs.clone(memory_format=torch.preserve_format).requires_grad_()
            out = module(leaf)
            gradients = torch.autograd.grad((out * _randn(rows, 96)).sum(), [leaf, *module.parameters()])
            results.append((out.detach(), *gradients))
        if has_onednn(inputs):
            assert type(layer(inputs).grad_fn).__name__ == "_LinearBackward"
        for got, wanted in zip(*results, strict=True):
            assert float((got - wanted).norm()) < 1e-5 * float(wanted.norm())


def test_gradient_of_a_plain_sum_and_of_expanded_inputs() -> None:
    layer, rows = Linear(128, 128), SMALLEST // 128**2
    leaf = _randn(1, 128).requires_grad_()
    (got,) = torch.autograd.grad(layer(leaf.expand(rows, 128)).sum(), leaf)  # both gradients have stride 0
    assert torch.allclose(got[0], rows * layer.weight.sum(0), rtol=1e-4, atol=1e-2)


def test_other_inputs_go_to_the_base_class() -> None:
    layer = Linear(128, 128)
    assert layer(_randn(3, 128)).grad_fn.name() == "AddmmBackward0"
    assert layer(_randn(2, 600, 128)).shape == (2, 600, 128)
    assert copy.deepcopy(layer).double()(_randn(600, 128).double()).dtype == torch.float64
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert layer(_randn(600, 128)).dtype == torch.bfloat16
