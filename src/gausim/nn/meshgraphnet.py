"""MeshGraphNet: encoder, message-passing processor, decoder (Pfaff et al. 2021)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.nn.mlp import mlp

NORMS = ("pre", "joint")


class _SplitLayer(nn.Module):
    """Layer with pre-norm and SiLU: the inputs of each update are normalised, and the update is added to the stream.

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
        source, destination = edge_index
        seen = self.node_norm(nodes)
        of_source, of_destination = self.from_nodes(seen).chunk(2, -1)
        ends = of_source.index_select(0, source) + of_destination.index_select(0, destination)
        edges = edges + self.edge_out(nn.functional.silu(self.from_edge(self.edge_norm(edges)) + ends))
        received = torch.zeros_like(nodes).index_add(0, destination, edges)
        return nodes + self.node(torch.cat((seen, received), -1)), edges


class _JointLayer(nn.Module):
    """The layer of the authors' code: MLPs of three linear layers, with one LayerNorm over all inputs of each.

    The summed messages are normalised with the node, so that the node stream does not grow from layer to layer.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.edge_norm, self.node_norm = nn.LayerNorm(3 * hidden), nn.LayerNorm(2 * hidden)
        self.edge = mlp((3 * hidden, hidden, hidden, hidden))
        self.node = mlp((2 * hidden, hidden, hidden, hidden))

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        source, destination = edge_index
        joined = torch.cat((edges, nodes.index_select(0, destination), nodes.index_select(0, source)), -1)
        edges = edges + self.edge(self.edge_norm(joined))
        received = torch.zeros_like(nodes).index_add(0, destination, edges)
        return nodes + self.node(self.node_norm(torch.cat((nodes, received), -1))), edges


class MeshGraphNet(nn.Module):
    """Encoder, ``layers`` message-passing layers, decoder hidden -> hidden/2 -> hidden/4 -> outputs."""

    def __init__(
        self,
        *,
        node_features: int,
        edge_features: int,
        outputs: int,
        hidden: int = 48,
        layers: int = 3,
        norm: str = "pre",
    ) -> None:
        """Builds the network.

        Args:
            node_features: number of features per node.
            edge_features: number of features per edge.
            outputs: number of outputs per node.
            hidden: width of all hidden layers.
            layers: message-passing layers.
            norm: LayerNorm ``pre`` (of the inputs of a residual update), or ``joint``: the authors' layers, with three
                linear layers per MLP, one LayerNorm over all inputs of each, none before the decoder, and ReLU in
                encoders and decoder.

        Raises:
            ConfigError: unknown norm.
        """
        super().__init__()
        if norm not in NORMS:
            raise ConfigError(f"model.simulator.network.norm is '{norm}'; expected one of {', '.join(NORMS)}.")
        ends, layer = ("relu", _JointLayer) if norm == "joint" else ("silu", _SplitLayer)
        self.node_encoder = mlp((node_features, hidden, hidden), ends)
        self.edge_encoder = mlp((edge_features, hidden, hidden), ends)
        self.processor = nn.ModuleList(layer(hidden) for _ in range(layers))
        self.norm = nn.LayerNorm(hidden) if norm == "pre" else nn.Identity()
        self.decoder = mlp((hidden, hidden // 2, hidden // 4, outputs), ends)

    def forward(
        self, node_features: Float[Tensor, "N Cn"], edge_features: Float[Tensor, "E Ce"], edge_index: Int[Tensor, "2 E"]
    ) -> Float[Tensor, "N Co"]:
        """Outputs per node; ``edge_index`` is (source, destination), preferably sorted by destination."""
        nodes, edges = self.node_encoder(node_features), self.edge_encoder(edge_features)
        for layer in self.processor:
            nodes, edges = layer(nodes, edges, edge_index)
        result: Tensor = self.decoder(self.norm(nodes))
        return result
