"""Metrics of 3D motion: distance of points to the truth, and motion energy."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def point_error(
    prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"], diagonal: float
) -> Float[Tensor, " F"]:
    """Mean over points of the distance to the truth, as a percentage of the object's bounding-box diagonal."""
    return 100 * track_error(prediction, target) / diagonal


def track_error(prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F P 3"]) -> Float[Tensor, " F"]:
    """Mean over points of the distance to the truth [scene units]."""
    return (prediction - target).norm(dim=-1).mean(-1)


def motion_energy(frames: Float[Tensor, "F *N D"]) -> Float[Tensor, " F-1"]:
    """Sum of ||x_{t+1} - x_t||^2 over points or pixels, for every step.

    It detects predictions that dissipate or explode: a static or fast-dissipating one has a misleadingly low error on
    late frames, but the ratio of its energy to the true one is near 0.

    Args:
        frames: positions of points (D = 3, scene units), or colours of pixels (D = 3, RGB on black, so that pixels that
            remain background contribute zero).
    """
    return frames.diff(dim=0).square().sum(-1).flatten(1).sum(1)
