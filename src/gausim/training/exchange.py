"""Sums over ranks at the end of an optimiser step: loss gradients and input statistics."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.nn.normaliser import normalisers_of
from gausim.training.ranks.ranks import Ranks


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
    def step(self, weights: Sequence[Parameter]) -> None:
        """Adds the ranks' loss gradients and normaliser sums; a weight that no sequence uses keeps no gradient."""
        if self._ranks.size == 1:
            return
        gathered = self._gathered()
        total = self._ranks.add([*(p.grad for p in weights), *gathered], [*weights, *gathered])
        for weight, gradient in zip(weights, total, strict=False):
            weight.grad = gradient
        _assign(gathered, total[len(weights) :])

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
