from __future__ import annotations

import torch
from torch import Tensor

from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.mlp import mlp, zero_output


def _network() -> MeshGraphNet:
    torch.manual_seed(0)
    return MeshGraphNet(node_features=6, edge_features=5, outputs=11, hidden=16, layers=3).double()


def _inputs() -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    nodes = torch.randn(12, 6, generator=generator, dtype=torch.float64)
    edges = torch.randn(40, 5, generator=generator, dtype=torch.float64)
    return nodes, edges, torch.randint(0, 11, (2, 40), generator=generator)  # node 11 has no edges


def _naive(network: MeshGraphNet, nodes: Tensor, edges: Tensor, index: Tensor) -> Tensor:
    """The textbook form: the edge update sees the concatenation [edge, source, destination]."""
    x, e = network.node_encoder(nodes), network.edge_encoder(edges)
    for layer in network.processor:
        n = layer.node_norm(x)
        hidden = n.shape[1]
        weight = torch.cat((layer.from_edge.weight, *layer.from_nodes.weight.split(hidden)), 1)
        joined = torch.cat((layer.edge_norm(e), n[index[0]], n[index[1]]), 1)
        e = e + layer.edge_out(torch.nn.functional.silu(joined @ weight.T + layer.from_edge.bias))
        received = torch.stack([e[index[1] == i].sum(0) for i in range(len(x))])
        x = x + layer.node(torch.cat((n, received), 1))
    return network.decoder(network.norm(x))


def test_split_first_layer_equals_concatenation_in_values_and_gradients() -> None:
    network, inputs = _network(), _inputs()
    weight = torch.randn(12, 11, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    gradients = []
    outputs = []
    for function in (network, lambda *x: _naive(network, *x)):
        leaves = [v.clone().requires_grad_() for v in inputs[:2]]
        outputs.append(function(*leaves, inputs[2]))
        gradients.append(torch.autograd.grad((outputs[-1] * weight).sum(), [*leaves, *network.parameters()]))
    assert torch.allclose(*outputs, atol=1e-12)
    for got, wanted in zip(*gradients, strict=True):
        assert float(wanted.abs().max()) > 0
        assert torch.allclose(got, wanted, atol=1e-10)


def test_permuting_nodes_and_edges_permutes_outputs() -> None:
    network, (nodes, edges, index) = _network(), _inputs()
    generator = torch.Generator().manual_seed(3)
    order, edge_order = torch.randperm(12, generator=generator), torch.randperm(40, generator=generator)
    inverse = torch.argsort(order)
    permuted = network(nodes[order], edges[edge_order], inverse[index[:, edge_order]])
    plain = network(nodes, edges, index)
    assert torch.allclose(permuted, plain[order], atol=1e-12)
    assert bool(((plain - plain[order]).abs() > 1e-3).any())


def test_graph_without_edges() -> None:
    network, (nodes, _, _) = _network(), _inputs()
    out = network(nodes, torch.zeros(0, 5, dtype=torch.float64), torch.zeros(2, 0, dtype=torch.long))
    assert out.shape == (12, 11) and bool(torch.isfinite(out).all())


def test_zero_output_silences_only_the_last_layer() -> None:
    network = mlp((4, 8, 3))
    zero_output(network)
    assert torch.equal(network(torch.randn(5, 4)), torch.zeros(5, 3))
    assert float(network[0].weight.abs().max()) > 0
