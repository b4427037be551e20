"""Running mean and variance of network inputs, as in MeshGraphNets (Pfaff et al. 2021)."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn


class RunningNormaliser(nn.Module):
    """Normalises the first ``size`` features by statistics gathered in training; the others pass unchanged.

    In training mode a call adds its features to ``gathered``; :meth:`absorb` adds these sums to the statistics. Between
    two calls of :meth:`absorb` the layer is a fixed function, so that an optimiser step has the loss gradient of one
    function and can be divided over ranks, whose ``gathered`` are added first. Without statistics, features pass
    unchanged.

    Statistics are buffers (part of the checkpoint) in float64. The standard deviation is floored because x_{-1} = X
    makes every velocity zero at the start.

    Attributes:
        gathered: number, sum and sum of squares of the features since :meth:`absorb`; not part of the checkpoint.
        frozen: whether calls in training mode leave ``gathered`` unchanged.
    """

    count: Tensor
    total: Tensor
    squares: Tensor
    updates: Tensor
    gathered: Float[Tensor, " G"]

    def __init__(self, size: int, *, floor: float = 1e-2, max_updates: int = 100_000) -> None:
        """Starts without statistics.

        Args:
            size: number of normalised features.
            floor: smallest standard deviation, in the unit of each feature.
            max_updates: calls of :meth:`absorb` after which the statistics are constant.
        """
        super().__init__()
        self.size, self.floor, self.max_updates, self.frozen = size, floor, max_updates, False
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("gathered", torch.zeros(1 + 2 * size, dtype=torch.float64), persistent=False)

    def forward(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """(x - mean) / std of the first ``size`` columns."""
        head, tail = features[:, : self.size], features[:, self.size :]
        if self.training and not self.frozen:
            self._gather(head.detach().double())
        count = self.count.clamp_min(1.0)
        mean = self.total / count
        std = (self.squares / count - mean * mean).clamp_min(0).sqrt().clamp_min(self.floor)
        std = torch.where(self.count > 0, std, torch.ones_like(std))
        return torch.cat(((head - mean.to(head)) / std.to(head), tail), 1)

    @torch.no_grad()
    def _gather(self, values: Tensor) -> None:
        self.gathered[0] += values.shape[0]
        self.gathered[1:] += torch.cat((values.sum(0), (values * values).sum(0)))

    @torch.no_grad()
    def absorb(self) -> None:
        """Adds the gathered sums to the statistics, without a read on the host."""
        counts = (self.gathered[0] > 0) & (self.updates < self.max_updates)
        number, total, squares = self.gathered.split((1, self.size, self.size))
        for statistic, seen in ((self.count, number[0]), (self.total, total), (self.squares, squares)):
            statistic += torch.where(counts, seen, torch.zeros_like(seen))
        self.updates += counts
        self.gathered.zero_()


def normalisers_of(module: nn.Module) -> list[RunningNormaliser]:
    """All normalisers of a module, in its order."""
    return [m for m in module.modules() if isinstance(m, RunningNormaliser)]


@contextmanager
def gathering_nothing(normalisers: Iterable[RunningNormaliser]) -> Iterator[None]:
    """Context in which calls gather no statistics, for the recomputation of a step."""
    held = [(n, n.frozen) for n in normalisers]
    for normaliser, _ in held:
        normaliser.frozen = True
    try:
        yield
    finally:
        for normaliser, before in held:
            normaliser.frozen = before
