"""Base of the metrics that are a mean over images or frames, also over those of other ranks."""

from __future__ import annotations

from abc import ABC
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


class PooledMean(Metric, ABC):
    """Mean of all values added so far; sums are reduced over ranks, so every rank computes the same mean.

    Attributes:
        key: name in result files.
        label: name in tables and figures.
        scale: tables print the value times this.
        unit: what the printed number is in.
        higher_is_better: which way is good.
    """

    key: ClassVar[str]
    label: ClassVar[str]
    scale: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""
    higher_is_better = False
    is_differentiable = True
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def add(self, values: Float[Tensor, " n"]) -> None:
        """Adds values, each with the weight of one; a NaN among them makes the mean NaN."""
        self.total += values.detach().double().sum()
        self.count += values.shape[0]

    def compute(self) -> Float[Tensor, ""]:
        """Mean over all values seen so far."""
        return self.total / self.count
