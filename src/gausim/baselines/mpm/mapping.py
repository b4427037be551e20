"""From the scene's coordinates to the simulation's and back."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SceneMapping:
    """x_sim = scale x + offset: no rotation, so that gradients and rotations are the same in both.

    Attributes:
        scale: simulation units per scene unit.
        offset: where the scene's origin goes [simulation units].
    """

    scale: float
    offset: Vector

    def to_simulation(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the simulation."""
        return self.scale * points + points.new_tensor(self.offset)

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the scene."""
        return (points - points.new_tensor(self.offset)) / self.scale
