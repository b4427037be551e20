"""3D error of predicted points where the true motion is known."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


def point_error(
    prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"], diagonal: float
) -> Float[Tensor, " F"]:
    """Mean over points of the distance to the truth, as a percentage of the object's bounding-box diagonal."""
    return 100 * (prediction - target).norm(dim=-1).mean(-1) / diagonal


class Error3D(Metric):
    """Mean over frames of :func:`point_error` [% of the diagonal]; sums are reduced over ranks."""

    key = "error_3d"
    label = "3D error"
    scale = 1.0
    unit = "% of diagonal"
    higher_is_better = False
    is_differentiable = True
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"], diagonal: float) -> None:
        """Adds the frames of one trajectory.

        Args:
            prediction: predicted positions [scene units].
            target: true positions of the same points [scene units].
            diagonal: bounding-box diagonal of the object [scene units].
        """
        self.total += point_error(prediction, target, diagonal).detach().double().sum()
        self.count += prediction.shape[0]

    def compute(self) -> Float[Tensor, ""]:
        """Mean over all frames seen so far."""
        return self.total / self.count
