"""A predicted frame of a body in scene axes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Placed(NamedTuple):
    """Kernels and units of a body, in scene axes."""

    positions: Float[Tensor, "K 3"]  # kernel means [scene units]
    deformation_gradients: Float[Tensor, "R 3 3"]  # of the units and the identity row
    rotations: Float[Tensor, "R 3 3"]
    # positions one frame earlier as the next step has to see them, where an impact changed the velocity
    previous: Float[Tensor, "K 3"] | None = None


def turned_units(rotation: Float[Tensor, "3 3"], matrices: Float[Tensor, "R 3 3"]) -> Float[Tensor, "R 3 3"]:
    """Matrices of the units after a rotation of the body; the identity row, the last, stays."""
    return torch.cat((rotation @ matrices[:-1], matrices[-1:]))
