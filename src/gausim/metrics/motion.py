"""Metrics of 3D motion: distance of points to the truth, by level too, motion energy, and the bounce of a fall."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

# True points of the Chamfer distance per frame; of more, every n-th.
MOST_POINTS = 2000
# Height of the lowest point of a body at which it touches the floor [diagonals].
TOUCH = 0.01


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
    late frames, but the ratio of its energy to the true one is near 0. Points are in scene units; pixels are RGB on
    black, so that those that remain background contribute zero.
    """
    return frames.diff(dim=0).square().sum(-1).flatten(1).sum(1)


def chamfer(prediction: Float[Tensor, "F P 3"], target: Float[Tensor, "F Q 3"]) -> Float[Tensor, " F"]:
    """Mean over true points of the distance to the nearest predicted point [scene units], for every frame.

    It needs no correspondence of points, and therefore tells less than the track error.
    """
    every = -(-target.shape[1] // MOST_POINTS)
    predicted, true = (x.detach().cpu().double().numpy() for x in (prediction, target[:, ::every]))
    # Splitting at the middle instead of the median builds trees several times faster.
    pairs = zip(predicted, true, strict=True)
    means = [cKDTree(p, balanced_tree=False, compact_nodes=False).query(t)[0].mean() for p, t in pairs]
    return torch.from_numpy(np.array(means))


@dataclass(frozen=True)
class Bounce:
    """First bounce of a falling body [scene units]; NaN where it never lands, or has not risen again."""

    height: float  # highest point of the centre after the first contact, above the floor
    rise: float  # the same above the lowest point that the centre reached before
    depth: float  # deepest point of all below the floor, 0 if there is none


def bounce(heights: Float[NDArray[np.floating], "F P"], diagonal: float) -> Bounce:
    """The first bounce of points from their heights above the floor in every frame, and the diagonal [scene units]."""
    lowest, centre = heights.min(1), heights.mean(1)
    depth = max(0.0, -float(lowest.min()))
    landed = np.flatnonzero(lowest < TOUCH * diagonal)
    after = centre[landed[0] :] if len(landed) else centre[:0]
    rising = np.flatnonzero(np.diff(after) > 0)
    if not len(rising):
        return Bounce(np.nan, np.nan, depth)
    bottom = float(after[rising[0]])
    top = float(after[rising[0] :].max())
    return Bounce(top, top - bottom, depth)
