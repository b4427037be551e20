"""The textbook MeshGraphNet layer, reference of the network's tests and benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.nn.meshgraphnet import MeshGraphNet


def naive_network(
    network: MeshGraphNet,
    node_features: Float[Tensor, "N Cn"],
    edge_features: Float[Tensor, "E Ce"],
    edge_index: Int[Tensor, "2 E"],
) -> Float[Tensor, "N Co"]:
    """The function of ``network``, with its weights, in plain differentiable torch.

    The edge update has one linear layer on the concatenation [edge, source, destination] (Pfaff et al. 2021, equation
    1), whose matrix is composed of the three of the split form. Options of ``network`` have no effect.
    """
    nodes, edges = _mlp(network.node_encoder, node_features), _mlp(network.edge_encoder, edge_features)
    source, destination = edge_index
    layers: Iterable[Any] = network.processor
    for layer in layers:
        normed = layer.node_norm(nodes)
        weight = torch.cat((layer.from_edge.weight, *layer.from_nodes.weight.chunk(2)), 1)
        joined = (layer.edge_norm(edges), normed.index_select(0, source), normed.index_select(0, destination))
        hidden = nn.functional.linear(torch.cat(joined, 1), weight, layer.from_edge.bias)
        edges = edges + _linear(layer.edge_out, nn.functional.silu(hidden))
        received = torch.zeros_like(nodes).index_add(0, destination, edges)
        nodes = nodes + _mlp(layer.node, torch.cat((normed, received), 1))
    return _mlp(network.decoder, network.norm(nodes))


def _linear(layer: nn.Linear, inputs: Tensor) -> Tensor:
    return nn.functional.linear(inputs, layer.weight, layer.bias)


def _mlp(layers: nn.Sequential, inputs: Tensor) -> Tensor:
    for layer in layers:
        inputs = _linear(layer, inputs) if isinstance(layer, nn.Linear) else layer(inputs)
    return inputs
