"""Running mean and variance of network inputs, as in MeshGraphNets (Pfaff et al. 2021)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class RunningNormaliser(nn.Module):
    """Normalises the first ``size`` features by statistics gathered in training; the others pass unchanged.

    Statistics are buffers (part of the checkpoint), accumulate in float64 over at most ``max_updates`` calls in
    training mode and stay as they are in evaluation mode, or for good where ``frozen`` is set. The standard deviation
    is floored because x_{-1} = X makes every velocity zero at the start.
    """

    count: Tensor
    total: Tensor
    squares: Tensor
    updates: Tensor

    def __init__(self, size: int, *, floor: float = 1e-2, max_updates: int = 100_000) -> None:
        """``floor`` is the smallest standard deviation, in the features' own units."""
        super().__init__()
        self.size, self.floor, self.max_updates = size, floor, max_updates
        self.frozen = False
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))

    def forward(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """(x - mean) / std of the first ``size`` columns."""
        head, tail = features[:, : self.size], features[:, self.size :]
        if self.training and not self.frozen and head.shape[0] and int(self.updates) < self.max_updates:
            self._accumulate(head.detach().double())
        count = self.count.clamp_min(1.0)
        mean = self.total / count
        std = (self.squares / count - mean * mean).clamp_min(0).sqrt().clamp_min(self.floor)
        return torch.cat(((head - mean.to(head)) / std.to(head), tail), 1)

    @torch.no_grad()
    def _accumulate(self, values: Tensor) -> None:
        self.count += values.shape[0]
        self.updates += 1
        self.total += values.sum(0)
        self.squares += (values * values).sum(0)
