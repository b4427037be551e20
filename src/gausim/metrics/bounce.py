"""Bounce of a falling body: how high its centre comes after the first contact with the floor, and how deep it sinks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

# Height of the lowest point at which it touches the floor [diagonals].
TOUCH = 0.01


@dataclass(frozen=True)
class Bounce:
    """First bounce of one motion [scene units]; NaN where the body never lands, or has not risen again."""

    height: float  # highest point of the centre after the first contact, above the floor
    rise: float  # the same above the lowest point that the centre reached before
    depth: float  # deepest point of all below the floor, 0 if there is none


def bounce(heights: Float[NDArray[np.floating], "F P"], diagonal: float) -> Bounce:
    """The first bounce of points from their heights above the floor in every frame, and the diagonal [scene units]."""
    lowest, centre = heights.min(1), heights.mean(1)
    depth = max(0.0, -float(lowest.min()))
    landed = np.flatnonzero(lowest < TOUCH * diagonal)
    if not len(landed):
        return Bounce(np.nan, np.nan, depth)
    after = centre[landed[0] :]
    rising = np.flatnonzero(np.diff(after) > 0)
    if not len(rising):
        return Bounce(np.nan, np.nan, depth)
    bottom = float(after[rising[0]])
    top = float(after[rising[0] :].max())
    return Bounce(top, top - bottom, depth)
