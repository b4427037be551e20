"""What one optimiser step found: kept on the device, read in one go, joined over ranks, checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.dataset import SampleFacts
from gausim.training.baseline_metrics import SequenceBaseline, excess
from gausim.training.ranks.ranks import interleave
from gausim.training.rollout import check_reach, describe

Table = list[list[float]]


@dataclass(frozen=True)
class Numbers:
    """The numbers of a step over all sequences, on the host, as far as the rollout lasted.

    Attributes:
        images: image loss of each predicted frame (as many as the rollout lasted) and sequence.
        momentum: momentum loss of each predicted frame.
        motion: squared change of the predicted images, summed over the batch.
        static: the static loss, if this batch carried it.
        growth: of the energy of free motion, mean over sequences, if this batch looked at it.
        gradient_fraction: the momentum loss's fraction of the network's gradient, where it was measured.
        gradients: norm of each parameter group's gradient.
    """

    images: Table
    momentum: list[float]
    motion: float
    static: float | None
    growth: float | None
    gradient_fraction: float | None
    gradients: dict[str, float]

    def stats(self, steps: int, count: int, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
        """What is logged of a step.

        Args:
            steps: predicted steps T.
            count: sequences of the step.
            baselines: of each of them.
        """
        lasted = len(self.images)
        stats = {f"grad_{name}": value for name, value in self.gradients.items()}
        if self.gradient_fraction is not None:
            stats["momentum_share"] = self.gradient_fraction
        if self.static is not None:
            stats["loss_static"] = self.static
        if self.growth is not None:
            stats["energy_growth"] = self.growth
        stats.update(steps=float(steps), exploded=float(lasted < steps))
        if lasted:
            stats["loss_momentum"] = sum(self.momentum) / (steps * count)
            stats["loss_image"] = sum(map(sum, self.images)) / (lasted * count)
            stats.update(self._compare(baselines))
        return stats

    def _compare(self, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
        """The prediction's losses and motion against the static prediction's and the truth's."""
        table = self.images
        floor = static = first = moved = 0.0
        for baseline in baselines:
            floor += baseline.floor * len(table)
            static += sum(baseline.static[: len(table)])
            moved += sum(baseline.motion[: len(table)])
            first += baseline.static[0]
        loss = sum(map(sum, table))
        return {
            "ratio_static": loss / max(static, 1e-12),
            "excess_static": excess(loss, static, floor),
            "ratio_first": sum(table[0]) / max(first, 1e-12),
            "motion_energy": self.motion / max(moved, 1e-12),
        }


@dataclass(frozen=True)
class Found:
    """What one rank found, on the host, not yet checked.

    Attributes:
        reach: how far kernels moved, per stretch, step and sequence.
        images: image loss per stretch, step and sequence.
        momentum: momentum loss per stretch and step, summed over sequences.
        motion: squared change of the predicted images per stretch, summed over sequences.
        static: the static loss of the scenes that are this rank's, if any.
        growth: of the energy of free motion, this rank's sequences' part of the mean, if looked at.
        gradient_fraction: as in :class:`Numbers`, the same on all ranks.
        gradients: likewise.
    """

    reach: list[Table]
    images: list[Table]
    momentum: list[list[float]]
    motion: list[float]
    static: float | None
    growth: float | None
    gradient_fraction: float | None
    gradients: dict[str, float]

    @staticmethod
    def join(parts: Sequence[Found]) -> Found:
        """What one rank with all sequences would have found."""
        if len(parts) == 1:
            return parts[0]
        held = [part for part in parts if part.reach]  # the others had no sequence
        static = [part.static for part in parts if part.static is not None]
        growth = [part.growth for part in parts if part.growth is not None]
        return Found(
            reach=[_beside(tables) for tables in zip(*(s.reach for s in held), strict=True)],
            images=[_beside(tables) for tables in zip(*(s.images for s in held), strict=True)],
            momentum=[
                [sum(values) for values in zip(*lists, strict=True)]
                for lists in zip(*(s.momentum for s in held), strict=True)
            ],
            motion=[sum(values) for values in zip(*(s.motion for s in held), strict=True)],
            static=sum(static) if static else None,
            growth=sum(growth) if growth else None,
            gradient_fraction=parts[0].gradient_fraction,
            gradients=parts[0].gradients,
        )

    def numbers(self, samples: Sequence[SampleFacts], explosion: float) -> Numbers:
        """Ends the rollout at its first explosion and checks that all is finite.

        Args:
            samples: the sequences of the step.
            explosion: a stretch in which a kernel moves further than this does not count [diagonals].

        Raises:
            DivergenceError: a number is not finite; names the step and the sequence where there is one.
        """
        lasted = self._lasted(samples, explosion)
        numbers = Numbers(
            images=[row for table in self.images[:lasted] for row in table],
            momentum=[value for values in self.momentum[:lasted] for value in values],
            motion=sum(self.motion[:lasted]),
            static=self.static,
            growth=self.growth,
            gradient_fraction=self.gradient_fraction if lasted else None,  # of the first stretch
            gradients=self.gradients,
        )
        _check(numbers, samples)
        return numbers

    def _lasted(self, samples: Sequence[SampleFacts], explosion: float) -> int:
        """Number of stretches before the one that exploded."""
        start = 0
        for number, table in enumerate(self.reach):
            if check_reach(table, start, samples) > explosion:
                return number
            start += len(table)
        return len(self.reach)


@dataclass
class Statistics:
    """What one optimiser step found, stretch by stretch, on the device.

    Attributes:
        reach: how far kernels moved (:func:`gausim.training.rollout.reach`).
        images: image loss per predicted step and sequence.
        momentum: momentum loss per predicted step.
        motion: squared change of the predicted images, summed over the batch.
        static: the static loss, if this batch carries it.
        growth: of the energy of free motion, if this batch looks at it.
        pulls: gradients of the network by the image losses and by the momentum loss, where their ratio is measured.
        gradient_fraction: the momentum loss's fraction of the network's gradient.
    """

    reach: list[Float[Tensor, "T S"]] = field(default_factory=list)
    images: list[Float[Tensor, "T S"]] = field(default_factory=list)
    momentum: list[Float[Tensor, " T"]] = field(default_factory=list)
    motion: list[Float[Tensor, ""]] = field(default_factory=list)
    static: Float[Tensor, ""] | None = None
    growth: Float[Tensor, ""] | None = None
    pulls: tuple[Float[Tensor, " P"], Float[Tensor, " P"]] | None = None
    gradient_fraction: Float[Tensor, ""] | None = None

    def fetch(self, norms: Mapping[str, Tensor]) -> Found:
        """Fetches everything at once.

        Args:
            norms: norm of each parameter group's gradient.
        """
        single = [x for x in (self.static, self.growth, self.gradient_fraction) if x is not None]
        parts = [*self.reach, *self.images, *self.momentum, *self.motion, *single, *norms.values()]
        device = parts[0].device
        fetched = iter(torch.cat([p.detach().to(device, torch.float32).reshape(-1) for p in parts]).tolist())
        reach, images = ([_table(x, fetched) for x in kept] for kept in (self.reach, self.images))
        momentum = [_take(len(x), fetched) for x in self.momentum]
        motion = _take(len(self.motion), fetched)
        static = next(fetched) if self.static is not None else None
        growth = next(fetched) if self.growth is not None else None
        fraction = next(fetched) if self.gradient_fraction is not None else None
        return Found(reach, images, momentum, motion, static, growth, fraction, dict(zip(norms, fetched, strict=True)))


def _take(count: int, fetched: Iterator[float]) -> list[float]:
    return [next(fetched) for _ in range(count)]


def _table(like: Tensor, fetched: Iterator[float]) -> Table:
    return [_take(like.shape[1], fetched) for _ in range(like.shape[0])]


def _beside(tables: Sequence[Table]) -> Table:
    """Tables of the ranks' sequences as one of all sequences."""
    return [interleave(rows) for rows in zip(*tables, strict=True)]


def _check(numbers: Numbers, samples: Sequence[SampleFacts]) -> None:
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
