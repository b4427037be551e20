"""MeshGraphNet: encoder, message-passing processor, decoder (Pfaff et al. 2021)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.nn.mlp import mlp


class _Message(nn.Module):
    """One message-passing layer: residual edge and node updates with pre-norm.

    The edge MLP's first layer acts on [edge, source, destination]; it is split into three matrices so that the two
    node products are computed once per node instead of once per edge.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.edge_norm, self.node_norm = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.from_edge = nn.Linear(hidden, hidden)
        self.from_nodes = nn.Linear(hidden, 2 * hidden, bias=False)
        self.edge_out = nn.Linear(hidden, hidden)
        self.node = mlp((2 * hidden, hidden, hidden))

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        normed = self.node_norm(nodes)
        source, destination = self.from_nodes(normed).chunk(2, -1)
        hidden = self.from_edge(self.edge_norm(edges))
        hidden = hidden + source.index_select(0, edge_index[0]) + destination.index_select(0, edge_index[1])
        edges = edges + self.edge_out(nn.functional.silu(hidden))
        received = torch.zeros_like(nodes).index_add(0, edge_index[1], edges)
        return nodes + self.node(torch.cat((normed, received), -1)), edges


class MeshGraphNet(nn.Module):
    """Encoder, ``layers`` message-passing layers, decoder hidden -> hidden/2 -> hidden/4 -> outputs.

    One set of weights serves every level of the hierarchy (METHOD section 3).
    """

    def __init__(
        self, *, node_features: int, edge_features: int, outputs: int, hidden: int = 128, layers: int = 16
    ) -> None:
        """Sizes of the input and output features, the width of all hidden layers and the number of layers."""
        super().__init__()
        self.node_encoder = mlp((node_features, hidden, hidden))
        self.edge_encoder = mlp((edge_features, hidden, hidden))
        self.processor = nn.ModuleList(_Message(hidden) for _ in range(layers))
        self.norm = nn.LayerNorm(hidden)
        self.decoder = mlp((hidden, hidden // 2, hidden // 4, outputs))

    def forward(
        self, node_features: Float[Tensor, "N Cn"], edge_features: Float[Tensor, "E Ce"], edge_index: Int[Tensor, "2 E"]
    ) -> Float[Tensor, "N Co"]:
        """Outputs per node; ``edge_index`` holds (source, destination)."""
        nodes, edges = self.node_encoder(node_features), self.edge_encoder(edge_features)
        for layer in self.processor:
            nodes, edges = layer(nodes, edges, edge_index)
        return self.decoder(self.norm(nodes))
