"""Error of a prediction by level of a hierarchy, for coarse and fine motion."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def level_error(
    prediction: Float[Tensor, "F P 3"],
    target: Float[Tensor, "F P 3"],
    rest: Float[Tensor, "P 3"],
    unit: Int[Tensor, " P"],
) -> tuple[Float[Tensor, " F"], Float[Tensor, " F"]]:
    """Error of every frame, and of the rest state: mean distance of units' predicted and true centres [scene units].

    ``unit`` is the unit of each point at the level; -1 for points without a unit.
    """
    known = unit >= 0
    _, index = unit[known].unique(return_inverse=True)
    count = torch.bincount(index).to(target)[None, :, None]

    def size(difference: Tensor) -> Tensor:
        total = difference.new_zeros(len(difference), count.shape[1], 3).index_add(1, index, difference[:, known])
        return (total / count).norm(dim=-1).mean(-1)

    return size(prediction - target), size(rest - target)
