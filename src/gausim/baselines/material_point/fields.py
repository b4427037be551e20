"""Smooth functions of space to learn: a tri-plane and a small network behind it (PhysDreamer)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from gausim.nn.mlp import mlp, zero_output
from gausim.nn.planes import SUM, Planes


class TriPlaneField(nn.Module):
    """Summed features of three planes, a hidden layer with ReLU, and ``outputs`` numbers that are 0 at first.

    Attributes:
        planes: the features.
        network: what makes numbers of them.
    """

    def __init__(self, resolution: int, *, features: int = 32, hidden: int = 32, outputs: int = 1) -> None:
        """Draws its parameters from the global generator.

        Args:
            resolution: numbers along both axes of every plane.
            features: channels of a plane.
            hidden: width of the hidden layer.
            outputs: numbers at a point.

        Raises:
            ValueError: a resolution below 2.
        """
        super().__init__()
        self.planes = Planes([resolution] * 3, features, combine=SUM)
        self.network = mlp([features, hidden, outputs], "relu")
        zero_output(self.network)

    def forward(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P outputs"]:
        """Values at points in [-1, 1]^3."""
        found: Tensor = self.network(self.planes(points))
        return found
