"""3D error of predicted points where the true motion is known."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from gausim.metrics.mean import PooledMean


def point_error(
    prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"], diagonal: float
) -> Float[Tensor, " F"]:
    """Mean over points of the distance to the truth, as a percentage of the object's bounding-box diagonal."""
    return 100 * (prediction - target).norm(dim=-1).mean(-1) / diagonal


class Error3D(PooledMean):
    """Mean over frames of :func:`point_error` [% of the diagonal]."""

    key = "error_3d"
    label = "3D error"
    unit = "% of diagonal"

    def update(self, prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"], diagonal: float) -> None:
        """Adds the frames of one trajectory.

        Args:
            prediction: predicted positions [scene units].
            target: true positions of the same points [scene units].
            diagonal: bounding-box diagonal of the object [scene units].
        """
        self.add(point_error(prediction, target, diagonal))
