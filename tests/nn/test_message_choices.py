"""Layers of other choices than pre-norm and SiLU: against one edge and one node at a time."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.nn.meshgraphnet import MeshGraphNet

INDEX = torch.tensor([[1, 2, 0, 3, 1, 0], [0, 0, 1, 1, 2, 3]])
UNKNOWN = [("norm", "layer", "pre, post"), ("activation", "tanh", "silu, relu")]
CHOICES = [("post", "silu"), ("pre", "relu"), ("joint", "silu")]


def network(norm: str, activation: str, **how: object) -> MeshGraphNet:
    torch.manual_seed(0)
    made = MeshGraphNet(node_features=5, edge_features=4, outputs=3, hidden=8, layers=2,
                        norm=norm, activation=activation, **how)  # fmt: skip
    for name, value in made.named_parameters():
        if "norm" in name:
            nn.init.normal_(value, mean=1.0, std=0.3)
    return made.double()


def inputs() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return tuple(torch.randn(n, c, generator=generator, dtype=torch.float64) for n, c in ((5, 5), (6, 4)))  # fmt: skip


def gradients(made: MeshGraphNet) -> list[Tensor]:
    return list(torch.autograd.grad(made(*inputs(), INDEX).square().sum(), list(made.parameters())))


def by_hand(made: MeshGraphNet, norm: str, nodes: Tensor, edges: Tensor) -> Tensor:
    x, e = list(made.node_encoder(nodes)), list(made.edge_encoder(edges))
    for layer in made.processor:
        before = (layer.node_norm, layer.edge_norm) if norm == "pre" else (nn.Identity(), nn.Identity())
        after = (layer.node_norm, layer.edge_norm) if norm == "post" else (nn.Identity(), nn.Identity())
        seen = [before[0](v) for v in x]
        for k, (s, d) in enumerate(INDEX.T):
            if norm == "joint":
                e[k] = e[k] + layer.edge(layer.edge_norm(torch.cat((e[k], x[d], x[s]))))
                continue
            e[k] = e[k] + after[1](layer.edge(torch.cat((before[1](e[k]), seen[s], seen[d]))))
        for i in range(len(x)):
            received = sum((e[k] for k in range(len(e)) if INDEX[1, k] == i), torch.zeros_like(x[i]))
            if norm == "joint":
                x[i] = x[i] + layer.node(layer.node_norm(torch.cat((x[i], received))))
                continue
            x[i] = x[i] + after[0](layer.node(torch.cat((seen[i], received))))
    return made.decoder(torch.stack([made.norm(v) if norm == "pre" else v for v in x]))


@pytest.mark.parametrize(("norm", "activation"), CHOICES)
def test_choices_equal_the_same_by_hand(norm: str, activation: str) -> None:
    made = network(norm, activation)
    assert any(isinstance(m, nn.ReLU) for m in made.processor.modules()) == (activation == "relu")
    result = made(*inputs(), INDEX)
    assert torch.allclose(result, by_hand(made, norm, *inputs()), atol=1e-12)
    got, wanted = gradients(network(norm, activation, checkpoint=True)), gradients(made)
    assert all(torch.equal(a, b) for a, b in zip(got, wanted, strict=True))
    assert norm == "joint" or all(bool(a.any()) for a in got)  # a ReLU of so small a decoder may be dead


@pytest.mark.parametrize(("name", "value", "known"), UNKNOWN)
def test_unknown_choices_are_refused(name: str, value: str, known: str) -> None:
    with pytest.raises(ConfigError, match=rf"model\.simulator\.network\.{name} is '{value}'; expected one of {known}"):
        network(**{"norm": "pre", "activation": "silu", name: value})
