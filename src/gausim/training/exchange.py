"""Sums over ranks at the end of an optimiser step: loss gradients and input statistics."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.nn.normaliser import normalisers_of
from gausim.training.ranks.ranks import Ranks
from gausim.training.statistics import Statistics


class Exchange:
    """Sums of loss gradients and input statistics over ranks; with one rank, it updates the statistics only."""

    def __init__(self, ranks: Ranks, model: nn.Module) -> None:
        self._ranks, self._normalisers = ranks, normalisers_of(model)
        self._begun = False

    @torch.no_grad()
    def begin(self, see_first_frame: Callable[[], None]) -> None:
        """Initialises normalisers without statistics from the first frame of the ranks' first batches."""
        if not self._begun and not all(float(normaliser.count) for normaliser in self._normalisers):
            see_first_frame()
            gathered = self._gathered()
            _assign(gathered, self._ranks.add(gathered, gathered))
            self.absorb()
        self._begun = True

    @torch.no_grad()
    def step(self, weights: Sequence[Parameter], network: Sequence[Parameter], statistics: Statistics) -> None:
        """Adds the ranks' loss gradients and normaliser sums; a weight that no rank's sequences use keeps no gradient.

        The ``pulls`` in ``statistics``, gradients of the ``network``, are added as well, and their ratio is computed.
        """
        if self._ranks.size > 1:
            gathered = self._gathered()
            pull = weights[0].new_zeros(sum(p.numel() for p in network))
            mine: list[Tensor | None] = [*(p.grad for p in weights), *gathered, *(statistics.pulls or (None, None))]
            total = self._ranks.add(mine, [*weights, *gathered, pull, pull])
            for weight, gradient in zip(weights, total, strict=False):
                weight.grad = gradient
            _assign(gathered, total[len(weights) : -2])
            images, momentum = total[-2:]
            statistics.pulls = None if images is None or momentum is None else (images, momentum)
        if statistics.pulls is not None:
            by_images, by_momentum = (pull.norm() for pull in statistics.pulls)
            statistics.gradient_fraction = by_momentum / (by_images + by_momentum).clamp_min(1e-30)

    def absorb(self) -> None:
        """Updates the statistics with normaliser sums that are added already."""
        for normaliser in self._normalisers:
            normaliser.absorb()

    def _gathered(self) -> list[Tensor]:
        return [normaliser.gathered for normaliser in self._normalisers]


def _assign(targets: Sequence[Tensor], values: Sequence[Tensor | None]) -> None:
    for target, value in zip(targets, values, strict=True):
        if value is not None:
            target.copy_(value)
