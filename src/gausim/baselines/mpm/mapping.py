"""From the scene's coordinates to the simulation's and back."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError

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

    @staticmethod
    def physgaussian(means: Float[Tensor, "K 3"]) -> SceneMapping:
        """Longest side to 1, centred in [0, 2]^3 (PhysGaussian)."""
        low, high = means.double().amin(0), means.double().amax(0)
        scale = 1 / _longest(high - low)
        return SceneMapping(scale, _vector(1 - scale * (low + high) / 2))

    @staticmethod
    def physdreamer(means: Float[Tensor, "K 3"]) -> SceneMapping:
        """x_sim = (x - min + 0.25 range) / (1.8 range), in [0, 1]^3 (PhysDreamer).

        ``range`` is per axis in the numerator and the longest side in the denominator: the scale is the same on all
        axes, or stress would depend on the direction.
        """
        low, high = means.double().amin(0), means.double().amax(0)
        scale = 1 / (1.8 * _longest(high - low))
        return SceneMapping(scale, _vector(scale * (0.25 * (high - low) - low)))

    def to_simulation(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the simulation."""
        return self.scale * points + points.new_tensor(self.offset)

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the scene."""
        return (points - points.new_tensor(self.offset)) / self.scale

    def vector_to_simulation(self, vector: Vector, *, point: bool = False) -> Vector:
        """A velocity, acceleration or, with ``point``, a position given as three numbers."""
        x, y, z = (self.scale * v + (o if point else 0.0) for v, o in zip(vector, self.offset, strict=True))
        return (x, y, z)


def _longest(sides: Float[Tensor, " 3"]) -> float:
    side = float(sides.amax())
    if not side > 0:
        raise ConfigError(f"mapping: expected a scene of some extent, but its longest side is {side}.")
    return side


def _vector(values: Float[Tensor, " 3"]) -> Vector:
    x, y, z = (float(v) for v in values)
    return (x, y, z)
