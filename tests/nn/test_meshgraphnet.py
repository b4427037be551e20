from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.mlp import mlp, zero_output
from gausim.nn.planes import Planes

Graph = tuple[Tensor, Tensor, Tensor]


def _network(hidden: int = 16, layers: int = 3, **how: object) -> MeshGraphNet:
    torch.manual_seed(0)
    network = MeshGraphNet(node_features=6, edge_features=5, outputs=11, hidden=hidden, layers=layers, **how).double()
    for name, value in network.named_parameters():  # LayerNorm starts with ones and zeros, which hide mistakes
        if "norm" in name:
            torch.nn.init.normal_(value, mean=1.0, std=0.3)
    return network


def _inputs(nodes: int = 12, edges: int = 40) -> Graph:
    """The last node has no edges."""
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(nodes, 6, generator=generator, dtype=torch.float64)
    e = torch.randn(edges, 5, generator=generator, dtype=torch.float64)
    return x, e, torch.randint(0, nodes - 1, (2, edges), generator=generator)


def _differentiated(function: Callable[..., Tensor], network: MeshGraphNet, inputs: Graph) -> list[Tensor]:
    """Outputs, then the gradients of a weighted sum of them by both inputs and all parameters."""
    leaves = [value.clone().requires_grad_() for value in inputs[:2]]
    outputs = function(*leaves, inputs[2])
    weight = torch.randn(outputs.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    gradients = torch.autograd.grad((outputs * weight.to(outputs)).sum(), [*leaves, *network.parameters()])
    return [outputs.detach(), *gradients]


def _single(network: MeshGraphNet, inputs: Graph) -> Graph:
    """Everything to float32."""
    network.float()
    return inputs[0].float(), inputs[1].float(), inputs[2]


def _edge_update(layer: nn.Module, joined: Tensor) -> Tensor:
    """The MLP on [edge, source, destination]; the first matrix of the split form is composed of its three."""
    if hasattr(layer, "edge"):
        return layer.edge(joined)
    weight = torch.cat((layer.from_edge.weight, *layer.from_nodes.weight.chunk(2)), 1)
    hidden = nn.functional.linear(joined, weight, layer.from_edge.bias)
    return layer.edge_out(nn.functional.silu(hidden))


def _by_hand(network: MeshGraphNet, nodes: Tensor, edges: Tensor, edge_index: Tensor, norm: str = "pre") -> Tensor:
    """Equation 1 of Pfaff et al. (2021), one edge and one node at a time."""
    x, e = list(network.node_encoder(nodes)), list(network.edge_encoder(edges))
    for layer in network.processor:
        seen = [layer.node_norm(v) for v in x] if norm == "pre" else x
        for k, (s, d) in enumerate(edge_index.T):
            if norm == "joint":
                e[k] = e[k] + layer.edge(layer.edge_norm(torch.cat((e[k], x[d], x[s]))))
                continue
            e[k] = e[k] + _edge_update(layer, torch.cat((layer.edge_norm(e[k]), seen[s], seen[d])))
        for i in range(len(x)):
            received = sum((e[k] for k in range(len(e)) if edge_index[1, k] == i), torch.zeros_like(x[i]))
            if norm == "joint":
                x[i] = x[i] + layer.node(layer.node_norm(torch.cat((x[i], received))))
                continue
            x[i] = x[i] + layer.node(torch.cat((seen[i], received)))
    return network.decoder(network.norm(torch.stack(x)))


@pytest.mark.parametrize("norm", ["pre", "joint"])
def test_layers_equal_the_same_by_hand_in_values_and_gradients(norm: str) -> None:
    network, inputs = _network(norm=norm), _inputs()
    wanted = _differentiated(lambda *x: _by_hand(network, *x, norm), network, inputs)
    for got, value in zip(_differentiated(network, network, inputs), wanted, strict=True):
        assert float(value.abs().max()) > 0
        assert torch.allclose(got, value, rtol=0, atol=1e-10 * max(1.0, float(value.abs().max())))


def test_names_of_weights_last_layer_and_unknown_choices() -> None:
    with pytest.raises(ConfigError, match=r"model\.simulator\.network\.norm is 'post'; expected one of pre, joint"):
        _network(norm="post")
    keys = list(_network().state_dict())
    assert "processor.0.from_nodes.weight" in keys and "processor.2.node.2.bias" in keys and "decoder.4.bias" in keys
    network = mlp((4, 8, 3))
    zero_output(network)
    assert torch.equal(network(torch.randn(5, 4)), torch.zeros(5, 3))
    assert float(network[0].weight.abs().max()) > 0


def test_float32_equals_float64() -> None:
    network, inputs = _network(hidden=64), _inputs(80, 300)
    wanted = _differentiated(network, network, inputs)
    single = _single(network, inputs)
    for got, value in zip(_differentiated(network, network, single), wanted, strict=True):
        assert got.dtype == torch.float32
        assert float((got - value).norm()) < 1e-5 * float(value.norm())
    with torch.no_grad():
        assert float((network(*single) - wanted[0]).norm()) < 1e-5 * float(wanted[0].norm())


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
    network, empty = _network(), (torch.zeros(0, 5, dtype=torch.float64), torch.zeros(2, 0, dtype=torch.long))
    nodes = _inputs()[0]
    outputs, by_node, by_edge, *rest = _differentiated(network, network, (nodes, *empty))
    assert torch.allclose(outputs, _by_hand(network, nodes, *empty), atol=1e-12)
    assert bool(by_node.abs().max() > 0) and by_edge.shape == (0, 5)
    assert all(bool(torch.isfinite(value).all()) for value in rest)


def test_a_hexplane_has_six_planes_and_does_not_depend_on_time_at_first() -> None:
    planes = Planes([4, 5, 6, 3], 7)
    sizes = [(5, 4), (6, 4), (3, 4), (6, 5), (3, 5), (3, 6)]
    assert [tuple(p.shape[1:]) for p in planes.planes] == [(7, *size) for size in sizes]
    points = torch.rand(20, 4) * 2 - 1
    later = points.clone()
    later[:, 3] = 0.9
    torch.testing.assert_close(planes(points), planes(later))


@pytest.mark.parametrize("combine", ["sum", "product"])
def test_values_are_bilinear_between_corners_and_constant_beyond(combine: str) -> None:
    planes = Planes([2, 2, 2], 1, combine=combine)
    with torch.no_grad():
        for n, plane in enumerate(planes.planes):
            plane.copy_(torch.tensor([[1.0, 2.0], [3.0, 5.0]]) + n)
    points = torch.tensor([[-1.0, -1, -1], [0.5, -0.5, 0], [9, 9, 9]])
    corner = [[1.0, 2.0, 3.0], None, [5.0, 6.0, 7.0]]

    def bilinear(n: int, a: float, b: float) -> float:
        u, w = (a + 1) / 2, (b + 1) / 2
        return (1 - u) * (1 - w) * (1 + n) + u * (1 - w) * (2 + n) + (1 - u) * w * (3 + n) + u * w * (5 + n)

    corner[1] = [bilinear(0, 0.5, -0.5), bilinear(1, 0.5, 0), bilinear(2, -0.5, 0)]
    for row, values in zip(planes(points), corner, strict=True):
        assert values is not None
        expected = sum(values) if combine == "sum" else values[0] * values[1] * values[2]
        assert float(row) == pytest.approx(expected)


def test_penalties_look_along_their_own_axes() -> None:
    planes = Planes([3, 3, 3, 4], 2)
    with torch.no_grad():
        for plane in planes.planes:
            plane.fill_(0.3)
    assert float(planes.variation()) == float(planes.unsteadiness()) == 0
    with torch.no_grad():
        planes.planes[2].copy_(torch.tensor([0.0, 1, 2, 3])[:, None].expand(4, 3))  # (x, t): steady growth in time
    assert float(planes.variation()) == 0 and float(planes.unsteadiness()) == pytest.approx(0, abs=1e-12)
    with torch.no_grad():
        planes.planes[2].copy_(torch.tensor([0.0, 1, 0, 1])[:, None].expand(4, 3))
        planes.planes[0].copy_(torch.tensor([0.0, 1, 2]).expand(3, 3))  # (x, y): slope 1 along x
    assert float(planes.unsteadiness()) == pytest.approx(4) and float(planes.variation()) == pytest.approx(1)
