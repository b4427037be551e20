"""Sums of values over the members of each unit."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor


def weighted_sum(
    values: Float[Tensor, "K C"], weights: Float[Tensor, " K"], index: Int[Tensor, " K"], count: int
) -> Float[Tensor, "N C"]:
    """Sum of w_k y_k over the members k of each of ``count`` units; ``index`` is the unit of every member."""
    return values.new_zeros(count, values.shape[1]).index_add(0, index, values * weights[:, None])
