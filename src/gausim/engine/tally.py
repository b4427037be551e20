"""What one optimiser step found: kept on the device, read in one go, checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.dataset import SequenceSample
from gausim.engine.rollout import check_reach, describe


@dataclass(frozen=True)
class Numbers:
    """The same on the host.

    Attributes:
        images: image loss of each predicted frame (as many as the rollout lasted) and sequence.
        momentum: momentum loss of each predicted frame.
        motion: squared change of the predicted images, summed over the batch.
        static: the static loss, if this batch carried it.
        share: the momentum loss's share of the network's gradient, where it was measured.
        gradients: norm of each parameter group's gradient.
    """

    images: list[list[float]]
    momentum: list[float]
    motion: float
    static: float | None
    share: float | None
    gradients: dict[str, float]


@dataclass
class Tally:
    """What one optimiser step found, stretch by stretch, on the device.

    Attributes:
        reach: how far kernels moved (:func:`gausim.engine.rollout.reach`).
        images: image loss per predicted step and sequence.
        momentum: momentum loss per predicted step.
        motion: squared change of the predicted images, summed over the batch.
        static: the static loss, if this batch carries it.
        share: the momentum loss's share of the network's gradient, where it was measured.
    """

    reach: list[Float[Tensor, "T S"]] = field(default_factory=list)
    images: list[Float[Tensor, "T S"]] = field(default_factory=list)
    momentum: list[Float[Tensor, " T"]] = field(default_factory=list)
    motion: list[Float[Tensor, ""]] = field(default_factory=list)
    static: Float[Tensor, ""] | None = None
    share: Float[Tensor, ""] | None = None

    def read(self, samples: Sequence[SequenceSample], norms: Mapping[str, Tensor], explosion: float) -> Numbers:
        """Fetches everything at once, ends the rollout at its first explosion and checks that all is finite.

        Args:
            samples: the batch.
            norms: norm of each parameter group's gradient.
            explosion: a stretch in which a kernel moves further than this does not count [diagonals].

        Raises:
            DivergenceError: a number is not finite; names the step and the sequence where there is one.
        """
        single = [x for x in (self.static, self.share) if x is not None]
        parts = [*self.reach, *self.images, *self.momentum, *self.motion, *single, *norms.values()]
        device = parts[0].device
        fetched = iter(torch.cat([p.detach().to(device, torch.float32).reshape(-1) for p in parts]).tolist())
        reach, images = ([_table(x, fetched) for x in kept] for kept in (self.reach, self.images))
        momentum = [_take(len(x), fetched) for x in self.momentum]
        motion = _take(len(self.motion), fetched)
        static = next(fetched) if self.static is not None else None
        share = next(fetched) if self.share is not None else None
        lasted = _lasted(reach, samples, explosion)
        numbers = Numbers(
            images=[row for table in images[:lasted] for row in table],
            momentum=[value for values in momentum[:lasted] for value in values],
            motion=sum(motion[:lasted]),
            static=static,
            share=share if lasted else None,  # of the first stretch
            gradients=dict(zip(norms, fetched, strict=True)),
        )
        _check(numbers, samples)
        return numbers


def _take(count: int, fetched: Iterator[float]) -> list[float]:
    return [next(fetched) for _ in range(count)]


def _table(like: Tensor, fetched: Iterator[float]) -> list[list[float]]:
    return [_take(like.shape[1], fetched) for _ in range(like.shape[0])]


def _lasted(reach: list[list[list[float]]], samples: Sequence[SequenceSample], explosion: float) -> int:
    """Number of stretches before the one that exploded."""
    start = 0
    for number, table in enumerate(reach):
        if check_reach(table, start, samples) > explosion:
            return number
        start += len(table)
    return len(reach)


def _check(numbers: Numbers, samples: Sequence[SequenceSample]) -> None:
    for t, row in enumerate(numbers.images):
        for value, sample in zip(row, samples, strict=True):
            if not abs(value) < float("inf"):
                raise DivergenceError(describe(t, samples, sample, f"the image loss is {value}"))
        if not abs(numbers.momentum[t]) < float("inf"):
            raise DivergenceError(describe(t, samples, None, f"the momentum loss is {numbers.momentum[t]}"))
    if numbers.static is not None and not abs(numbers.static) < float("inf"):
        raise DivergenceError(describe(None, samples, None, f"the static loss is {numbers.static}"))
    for name, value in numbers.gradients.items():
        if not abs(value) < float("inf"):
            raise DivergenceError(describe(None, samples, None, f"the gradient of group '{name}' is {value}"))
