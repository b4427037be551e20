"""Features of a point from planes of learned features: tri-planes of space, six planes of space and time (HexPlane)."""

import functools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

SUM, PRODUCT = "sum", "product"
# Range of initial features of spatial planes (K-Planes, 4DGS).
LOW, HIGH = 0.1, 0.5


class Planes(nn.Module):
    """One plane of features for each pair of D axes, interpolated bilinearly; D = 3 is a tri-plane, D = 4 a HexPlane.

    Planes of two of the first three axes are initialised at random, those with the fourth (time) with 1, so that a
    product is constant in time at first. Coordinates beyond [-1, 1] are clamped.

    Attributes:
        pairs: the axes of every plane.
        features: channels.
    """

    def __init__(self, resolution: Sequence[int], features: int = 32, *, combine: str = PRODUCT) -> None:
        """Draws the planes from the global generator.

        Args:
            resolution: number of grid points along each of the D axes.
            features: channels of every plane.
            combine: ``product`` or ``sum`` of the planes' features.

        Raises:
            ValueError: ``combine`` is unknown, or an axis has fewer than two grid points.
        """
        super().__init__()
        if combine not in (SUM, PRODUCT) or len(resolution) not in (3, 4) or min(resolution) < 2:
            raise ValueError(
                f"planes: expected product or sum of planes over 3 or 4 axes of at least 2 numbers each, got "
                f"{combine!r} over {list(resolution)}"
            )
        self.combine, self.features = combine, features
        axes = range(len(resolution))
        self.pairs = [(i, j) for i in axes for j in axes if i < j]
        self.planes = nn.ParameterList()
        for i, j in self.pairs:
            plane = torch.empty(1, features, resolution[j], resolution[i])
            self.planes.append(nn.init.ones_(plane) if j == 3 else nn.init.uniform_(plane, LOW, HIGH))

    def forward(self, points: Float[Tensor, "P D"]) -> Float[Tensor, "P features"]:
        """Features of points in [-1, 1]^D."""
        found = []
        for (i, j), plane in zip(self.pairs, self.planes, strict=True):
            places = torch.stack((points[:, i], points[:, j]), -1)[None, None]
            sampled = F.grid_sample(plane, places, mode="bilinear", padding_mode="border", align_corners=True)
            found.append(sampled[0, :, 0].T)
        return functools.reduce(torch.mul if self.combine == PRODUCT else torch.add, found)

    def variation(self) -> Float[Tensor, ""]:
        """Mean squared difference of neighbouring features along the spatial axes, summed over planes."""
        total = torch.zeros((), device=self.planes[0].device)
        for (_, j), plane in zip(self.pairs, self.planes, strict=True):
            total = total + plane.diff(dim=3).square().mean()  # axis i < 3 is always one of space
            if j < 3:
                total = total + plane.diff(dim=2).square().mean()
        return total

    def unsteadiness(self) -> Float[Tensor, ""]:
        """Mean squared second difference of features in time, summed over planes with time; 0 without time."""
        with_time = [plane for (_, j), plane in zip(self.pairs, self.planes, strict=True) if j == 3]
        none = torch.zeros((), device=self.planes[0].device)
        return sum((plane.diff(n=2, dim=2).square().mean() for plane in with_time if plane.shape[2] > 2), none)
