"""Motion energy: tells a prediction that moves rightly from one that dissipates or explodes.

A static or fast-dissipating prediction gets a deceptively low error on late frames; its ratio of predicted to true
motion energy is near 0, where the truth's is 1.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


def motion_energy(frames: Float[Tensor, "F *N D"], mass: Float[Tensor, "*N"] | None = None) -> Float[Tensor, " F-1"]:
    """Sum of m ||x_{t+1} - x_t||^2 over all places, for every step.

    Args:
        frames: positions of points (D = 3, scene units), or colours of pixels (D = 3, RGB on black: what stays
            background in both frames adds nothing, so that the sum runs over the foreground by itself).
        mass: weight of each place; 1 when None.

    Returns:
        One energy per step, F - 1 in all.
    """
    squared = frames.diff(dim=0).square().sum(-1)
    if mass is not None:
        squared = squared * mass
    return squared.reshape(squared.shape[0], -1).sum(-1)


class MotionEnergyRatio(Metric):
    """Predicted motion energy as a share of the true one, pooled over everything seen (1 is right, 0 is static)."""

    key = "motion_energy"
    label = "motion energy"
    scale = 1.0
    unit = "of the truth's"
    higher_is_better = None
    is_differentiable = False
    full_state_update = False

    predicted: Tensor
    true: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("predicted", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("true", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(
        self,
        prediction: Float[Tensor, "F *N D"],
        target: Float[Tensor, "F *N D"],
        mass: Float[Tensor, "*N"] | None = None,
    ) -> None:
        """Adds one sequence of frames (points or images)."""
        self.predicted += motion_energy(prediction, mass).detach().double().sum()
        self.true += motion_energy(target, mass).detach().double().sum()

    def compute(self) -> Float[Tensor, ""]:
        """The ratio; NaN where the truth did not move at all."""
        return self.predicted / torch.where(self.true > 0, self.true, torch.nan)
