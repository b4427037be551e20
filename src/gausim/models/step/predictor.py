"""The network's prediction: a deformation gradient F for every unit of a level (METHOD sections 2 and 3)."""

from collections.abc import Callable, Mapping
from typing import cast

from jaxtyping import Float
from torch import Tensor, nn

from gausim.models.hierarchy.batch import LevelBatch, exact_edges, fixed_edges
from gausim.models.step.features import FLOOR_FEATURES, FeatureOptions, network_inputs
from gausim.models.step.head import Head
from gausim.models.step.recursion import Solved, Units
from gausim.nn.mlp import zero_output as initialise_zero
from gausim.nn.normaliser import RunningNormaliser

# Ending of the name of the weights that read the node features.
READS_NODES = "node_encoder.0.weight"


def with_floor_columns(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights by name for a model with the shapes of ``expected``, with or without the columns of the floor's features.

    Both keep the function: new columns are zero, and the features of removed ones are zero without a floor.
    """
    fitting = dict(weights)
    for name in weights.keys() & expected.keys():
        if name.endswith(READS_NODES) and abs(expected[name].shape[1] - weights[name].shape[1]) == FLOOR_FEATURES:
            # A negative number of columns removes the last ones.
            fitting[name] = nn.functional.pad(weights[name], (0, expected[name].shape[1] - weights[name].shape[1]))
    return fitting


class DeformationPredictor(nn.Module):
    """Predictor of F of every unit from the states of the unit, its parent and its neighbours."""

    def __init__(
        self,
        *,
        features: FeatureOptions,
        network: Callable[..., nn.Module],
        head: Head,
        edges: str,
        conserve_mass: bool,
    ) -> None:
        """Builds the network, which all predicted levels share, and the normalisers of its inputs.

        ``network`` is called with node_features=, edge_features= and outputs=.
        """
        super().__init__()
        self.features, self.edges, self.head, self._conserve_mass = features, edges, head, conserve_mass
        self.node_normaliser = RunningNormaliser(features.node_normalised)
        self.edge_normaliser = RunningNormaliser(features.edge_normalised)
        sizes = {"node_features": features.node_size, "edge_features": features.edge_size, "outputs": head.outputs}
        self.network = network(**sizes)
        if head.zero_output:
            initialise_zero(cast(nn.Sequential, self.network.decoder))

    def forward(
        self, level: LevelBatch, unit: Units, above: Solved, target: Float[Tensor, "N 3"], position: int
    ) -> Float[Tensor, "N O"]:
        """The network's raw output for each unit of the level at ``position``, coarse to fine.

        ``above`` are the solved parents, ``target`` the units' template positions [scene units].
        """
        coarse = self.features.coarse_inputs and position > 0
        fixed = self._fixes_shapes(unit.now)
        edge_index = (fixed_edges if fixed else exact_edges)(self.edges, level, unit.now)
        # Edges of the dummy node come last; their features reach no unit, so those of any node serve.
        present = edge_index.clamp_max(level.count - 1) if fixed else edge_index
        nodes, edges = network_inputs(
            unit, target, above, present, level.length, level.dt, self.features, coarse=coarse
        )
        nodes, edges = self.node_normaliser(nodes), self.edge_normaliser(edges)
        if fixed:
            nodes = nn.functional.pad(nodes, (0, 0, 0, 1))
        output: Tensor = self.network(nodes, edges, edge_index)[: level.count]
        return output

    def deformation_gradient(
        self, output: Float[Tensor, "N O"], level: LevelBatch, above: Solved, target: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3 3"]]:
        """F and its rotation of each unit; the identity where the output is zero."""
        lever = above.carry(target) - above.after.index_select(0, above.index) if self.head.lever else None
        return self.head(output, lever, level.length, conserve_mass=self._conserve_mass)

    def _fixes_shapes(self, positions: Tensor) -> bool:
        """Whether the number of edges must not depend on the state, as steps may be captured in a CUDA graph."""
        return self.edges != "rest" and positions.device.type == "cuda" and not self.training
