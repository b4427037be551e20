"""What the ranks add up at the end of an optimiser step: gradients and statistics of inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.nn.normaliser import normalisers_of
from gausim.training.ranks.ranks import Ranks
from gausim.training.statistics import Statistics


class Exchange:
    """Makes the parts of the ranks the step of one rank; for a rank that is alone, it only keeps the statistics."""

    def __init__(self, ranks: Ranks, model: nn.Module) -> None:
        self._ranks, self._normalisers = ranks, normalisers_of(model)
        self._begun = False

    def begin(self, see_first_frame: Callable[[], None]) -> None:
        """Before the first step: normalisers without statistics see the first frame of the ranks' first batches."""
        if not self._begun and not all(float(normaliser.count) for normaliser in self._normalisers):
            see_first_frame()
            self.statistics()
        self._begun = True

    @torch.no_grad()
    def step(self, weights: Sequence[Parameter], network: Sequence[Parameter], statistics: Statistics) -> None:
        """Adds gradients and what normalisers gathered; a weight that is in no rank's sequences keeps no gradient.

        The pulls in ``statistics``, of the weights of the ``network``, become those of all sequences, and their ratio
        is formed.
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

    @torch.no_grad()
    def statistics(self) -> None:
        """Adds what normalisers gathered, and takes it into their statistics."""
        gathered = self._gathered()
        _assign(gathered, self._ranks.add(gathered, gathered))
        self.absorb()

    def absorb(self) -> None:
        """Takes what normalisers gathered, added already, into their statistics."""
        for normaliser in self._normalisers:
            normaliser.absorb()

    def _gathered(self) -> list[Tensor]:
        return [normaliser.gathered for normaliser in self._normalisers]


def _assign(targets: Sequence[Tensor], values: Sequence[Tensor | None]) -> None:
    for target, value in zip(targets, values, strict=True):
        if value is not None:
            target.copy_(value)
