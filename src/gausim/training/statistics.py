"""Statistics of an optimiser step: stored on the device, read at once, joined over ranks, checked and compared.

They are compared with the baseline metrics of each training sequence: the static prediction's losses, and the squared
change of the truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.training.ranks.ranks import interleave
from gausim.training.rollout import check_reach, describe
from gausim.training.supervision.images import Supervision

Table = list[list[float]]
# Measured in every stretch, and at most once per step.
SERIES, SINGLE = ("reach", "images", "momentum", "motion"), ("static", "growth", "gradient_fraction")


@dataclass
class SequenceBaseline:
    """Baseline metrics of one sequence, for the frames measured so far."""

    floor: float = 0.0  # loss of the rest state on frame 0, due to the reconstruction
    static: list[float] = field(default_factory=list)  # loss of the rest state on frames 1, 2, ..
    # squared change of the truth from frame t to t + 1 (images: summed over pixels)
    motion: list[float] = field(default_factory=list)


def excess(loss: float, static: float, floor: float) -> float:
    """A loss over that of the rest state, both less the floor; finite also before any motion."""
    return (loss - floor) / max(static - floor, 1e-3 * static, 1e-12)


class Baselines:
    """Cache of the baseline metrics of sequences, each measured once."""

    def __init__(self, supervision: Supervision) -> None:
        self._supervision = supervision
        self._known: dict[int, SequenceBaseline] = {}

    def of(self, sample: SequenceSample, rest: Tensor) -> SequenceBaseline:
        """The baseline of a sample's sequence, for at least the sample's frames; ``rest`` are its rest positions.

        That of a sample from a later frame on is not kept.
        """
        known = SequenceBaseline()
        if not sample.start:
            known = self._known.setdefault(sample.sequence_id, known)
        seen = len(known.static)
        if seen < sample.steps:
            losses, motion = self._supervision.static(sample, rest, seen)
            if seen == 0 and len(sample.cameras.names):  # true points have no error of a reconstruction
                known.floor = losses[0]
            known.static += losses[1:]
            known.motion += motion
        return known

    def learn(self, samples: Sequence[SampleFacts], baselines: Sequence[SequenceBaseline]) -> None:
        """Stores the ranks' baselines, so that all ranks have the same."""
        found = zip(samples, baselines, strict=True)
        self._known.update((sample.sequence_id, known) for sample, known in found if not sample.start)

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """The baseline of each sequence; measuring again in other groups of frames would change the last bits."""
        return {sequence: asdict(known) for sequence, known in self._known.items()}

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """Restores the baselines."""
        self._known = {sequence: SequenceBaseline(**known) for sequence, known in state.items()}


@dataclass(frozen=True)
class Found:
    """Statistics of a step on the host."""

    reach: list[Table]  # largest distance of a kernel from rest, per stretch, step and sequence [diagonals]
    images: list[Table]  # image loss per stretch, step and sequence
    momentum: list[list[float]]  # momentum loss per stretch and step, summed over sequences
    motion: list[float]  # squared change of the predicted images per stretch, summed over sequences
    static: float | None  # the static loss of this rank's scenes, if the batch had this term
    growth: float | None  # energy growth of free motion, this rank's part of the mean, if measured
    # the momentum loss's fraction of the network's loss gradient, if measured; equal on all ranks
    gradient_fraction: float | None
    gradients: dict[str, float]  # norm of each parameter group's loss gradient; equal on all ranks

    @staticmethod
    def join(parts: Sequence[Found]) -> Found:
        """The statistics that one rank with all sequences would have."""
        if len(parts) == 1:
            return parts[0]
        held = [part for part in parts if part.reach]  # the others had no sequence
        reach, images, momentum, motion = (
            list(zip(*(getattr(part, name) for part in held), strict=True)) for name in SERIES
        )
        joined: dict[str, Any] = {"motion": list(map(sum, motion))}
        joined["momentum"] = [[sum(values) for values in zip(*lists, strict=True)] for lists in momentum]
        for name, stretches in (("reach", reach), ("images", images)):
            joined[name] = [[interleave(rows) for rows in zip(*tables, strict=True)] for tables in stretches]
        for name in ("static", "growth"):
            known = [value for part in parts if (value := getattr(part, name)) is not None]
            joined[name] = sum(known) if known else None
        return replace(parts[0], **joined)

    @property
    def frames(self) -> Table:
        """Image loss of each predicted frame and sequence."""
        return [row for table in self.images for row in table]

    def lasting(self, samples: Sequence[SampleFacts], explosion: float) -> Found:
        """Ends the rollout of the samples at its first explosion and checks that all values are finite.

        A stretch in which a kernel moves further than ``explosion`` [diagonals] is left out.

        Raises:
            DivergenceError: a value is not finite; names the step and the sequence, if it has one.
        """
        start = lasted = 0
        for table in self.reach:
            if check_reach(table, start, samples) > explosion:
                break
            start, lasted = start + len(table), lasted + 1
        fraction = self.gradient_fraction if lasted else None  # of the first stretch
        found = replace(self, **{name: getattr(self, name)[:lasted] for name in SERIES}, gradient_fraction=fraction)
        found._check(samples)
        return found

    def _check(self, samples: Sequence[SampleFacts]) -> None:
        momentum = [value for values in self.momentum for value in values]
        checked: list[tuple[float, int | None, SampleFacts | None, str]] = []
        for t, row in enumerate(self.frames):
            checked += [(v, t, sample, "the image loss") for v, sample in zip(row, samples, strict=True)]
            checked.append((momentum[t], t, None, "the momentum loss"))
        checked.append((self.static or 0.0, None, None, "the static loss"))
        checked += [(v, None, None, f"the gradient of group '{name}'") for name, v in self.gradients.items()]
        for value, step, sample, what in checked:
            if not abs(value) < float("inf"):
                raise DivergenceError(describe(step, samples, sample, f"{what} is {value}"))

    def stats(self, steps: int, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
        """Logged metrics of a step of T = ``steps`` predicted frames, from the baselines of its sequences."""
        frames, count = self.frames, len(baselines)
        single = {
            "momentum_share": self.gradient_fraction, "loss_static": self.static, "energy_growth": self.growth,
        }  # fmt: skip
        stats = {f"grad_{name}": value for name, value in self.gradients.items()}
        stats.update({name: value for name, value in single.items() if value is not None})
        stats.update(steps=float(steps), exploded=float(len(frames) < steps))
        if frames:
            stats["loss_momentum"] = sum(value for values in self.momentum for value in values) / (steps * count)
            stats["loss_image"] = sum(map(sum, frames)) / (len(frames) * count)
            stats.update(_compare(frames, sum(self.motion), baselines))
        return stats


@dataclass
class Statistics:
    """Statistics of an optimiser step on the device, by stretch; :class:`Found` explains the attributes."""

    reach: list[Float[Tensor, "T S"]] = field(default_factory=list)
    images: list[Float[Tensor, "T S"]] = field(default_factory=list)
    momentum: list[Float[Tensor, " T"]] = field(default_factory=list)
    motion: list[Float[Tensor, ""]] = field(default_factory=list)
    static: Float[Tensor, ""] | None = None
    growth: Float[Tensor, ""] | None = None
    # the network's gradients of the image losses and of the momentum loss, where their ratio is measured
    pulls: tuple[Float[Tensor, " P"], Float[Tensor, " P"]] | None = None
    gradient_fraction: Float[Tensor, ""] | None = None

    def fetch(self, norms: Mapping[str, Tensor]) -> Found:
        """Copies all statistics and the norms of the parameter groups' loss gradients to the host at once."""
        parts = [x for name in SERIES for x in getattr(self, name)]
        parts += [x for x in (*(getattr(self, name) for name in SINGLE), *norms.values()) if x is not None]
        device = parts[0].device
        numbers = iter(torch.cat([p.detach().to(device, torch.float32).reshape(-1) for p in parts]).tolist())
        found: dict[str, Any] = {name: [_take(x.shape, numbers) for x in getattr(self, name)] for name in SERIES}
        found |= {name: None if getattr(self, name) is None else next(numbers) for name in SINGLE}
        return Found(**found, gradients=dict(zip(norms, numbers, strict=True)))


def _take(shape: Sequence[int], numbers: Iterator[float]) -> Any:
    """Nested lists of a shape, filled from ``numbers``."""
    return [_take(shape[1:], numbers) for _ in range(shape[0])] if shape else next(numbers)


def _compare(frames: Table, motion: float, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
    """Losses relative to those of the static prediction, and motion energy relative to the truth."""
    floor = static = first = moved = 0.0
    for baseline in baselines:
        floor += baseline.floor * len(frames)
        static += sum(baseline.static[: len(frames)])
        moved += sum(baseline.motion[: len(frames)])
        first += baseline.static[0]
    loss = sum(map(sum, frames))
    return {
        "ratio_static": loss / max(static, 1e-12),
        "excess_static": excess(loss, static, floor),
        "ratio_first": sum(frames[0]) / max(first, 1e-12),
        "motion_energy": motion / max(moved, 1e-12),
    }
