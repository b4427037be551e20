"""Sums of values over the members of each unit."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor


def weighted_sum(
    values: Float[Tensor, "K 3"], weights: Float[Tensor, " K"], index: Int[Tensor, " K"], count: int
) -> Float[Tensor, "N 3"]:
    """Sum of w_k y_k over the members k of each of ``count`` units; ``index`` is the unit of every member."""
    return values.new_zeros(count, 3).index_add(0, index, values * weights[:, None])
