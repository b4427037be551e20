"""Figures of an optimiser step: measured on the device, joined over ranks, checked and compared.

They are compared with the baseline metrics of each training sequence: the static prediction's losses, and the squared
change of the truth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.training.ranks.ranks import interleave
from gausim.training.rollout import describe
from gausim.training.supervision.images import Supervision

Table = list[list[float]]


@dataclass
class SequenceBaseline:
    """Baseline metrics of one sequence, for the frames measured so far."""

    floor: float = 0.0  # loss of the rest state on frame 0, due to the reconstruction
    static: list[float] = field(default_factory=list)  # loss of the rest state on frames 1, 2, ..
    # squared change of the truth from frame t to t + 1 (images: summed over pixels)
    motion: list[float] = field(default_factory=list)

    def extend(self, supervision: Supervision, sample: SequenceSample, rest: Tensor) -> None:
        """Measures the frames of a sample that are not known yet; ``rest`` are its rest positions."""
        seen = len(self.static)
        if seen < sample.steps:
            losses, motion = supervision.static(sample, rest, seen)
            if seen == 0 and len(sample.cameras.names):  # true points have no error of a reconstruction
                self.floor = losses[0]
            self.static += losses[1:]
            self.motion += motion


def excess(loss: float, static: float, floor: float) -> float:
    """A loss over that of the rest state, both less the floor; finite also before any motion."""
    return (loss - floor) / max(static - floor, 1e-3 * static, 1e-12)


class Baselines:
    """Cache of the baseline metrics of sequences, each measured once."""

    def __init__(self, supervision: Supervision) -> None:
        self._supervision = supervision
        self._known: dict[int, SequenceBaseline] = {}

    def of(self, sample: SequenceSample, rest: Tensor) -> SequenceBaseline:
        """The baseline of a sample's sequence, for at least the sample's frames; ``rest`` are its rest positions."""
        known = self._known.setdefault(sample.sequence_id, SequenceBaseline())
        known.extend(self._supervision, sample, rest)
        return known

    def learn(self, samples: Sequence[SampleFacts], baselines: Sequence[SequenceBaseline]) -> None:
        """Stores the ranks' baselines, so that all ranks have the same."""
        found = zip(samples, baselines, strict=True)
        self._known.update((sample.sequence_id, known) for sample, known in found)

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """The baseline of each sequence; measuring again in other groups of frames would change the last bits."""
        return {sequence: asdict(known) for sequence, known in self._known.items()}

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """Restores the baselines."""
        self._known = {sequence: SequenceBaseline(**known) for sequence, known in state.items()}


@dataclass(frozen=True)
class Measured:
    """Figures of an optimiser step on the host."""

    images: Table  # image loss of each predicted frame and sequence
    momentum: list[float]  # momentum loss of each frame, summed over sequences
    motion: float  # squared change of the predicted images, summed over frames and sequences
    static: float | None  # the static loss of this rank's scenes, if the batch had this term
    gradients: dict[str, float]  # norm of each parameter group's loss gradient; equal on all ranks

    @staticmethod
    def join(parts: "Sequence[Measured]") -> "Measured":
        """The figures that one rank with all sequences would have."""
        if len(parts) == 1:
            return parts[0]
        held = [part for part in parts if part.images]  # the others had no sequence
        images = [interleave(rows) for rows in zip(*(part.images for part in held), strict=True)]
        momentum = [sum(values) for values in zip(*(part.momentum for part in held), strict=True)]
        static = [part.static for part in parts if part.static is not None]
        motion = sum(part.motion for part in held)
        return Measured(images, momentum, motion, sum(static) if static else None, parts[0].gradients)

    def check(self, samples: Sequence[SampleFacts]) -> None:
        """Raises DivergenceError where a value is not finite; names the step and the sequence, if it has one."""
        checked: list[tuple[float, int | None, SampleFacts | None, str]] = []
        for t, row in enumerate(self.images):
            checked += [(v, t, sample, "the image loss") for v, sample in zip(row, samples, strict=True)]
            checked.append((self.momentum[t], t, None, "the momentum loss"))
        checked.append((self.static or 0.0, None, None, "the static loss"))
        checked += [(v, None, None, f"the gradient of group '{name}'") for name, v in self.gradients.items()]
        for value, step, sample, what in checked:
            if not abs(value) < float("inf"):
                raise DivergenceError(describe(step, samples, sample, f"{what} is {value}"))

    def stats(self, steps: int, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
        """Logged metrics of a step of T = ``steps`` predicted frames, from the baselines of its sequences."""
        frames, count = self.images, len(baselines)
        stats = {f"grad_{name}": value for name, value in self.gradients.items()}
        if self.static is not None:
            stats["loss_static"] = self.static
        stats.update(steps=float(steps), exploded=float(len(frames) < steps))
        if frames:
            stats["loss_momentum"] = sum(self.momentum) / (steps * count)
            stats["loss_image"] = sum(map(sum, frames)) / (len(frames) * count)
            stats.update(relative(frames, self.motion, baselines))
        return stats


@dataclass
class Statistics:
    """Figures of an optimiser step on the device, by stretch; :class:`Measured` explains them."""

    images: list[Float[Tensor, "T S"]] = field(default_factory=list)
    momentum: list[Float[Tensor, " T"]] = field(default_factory=list)
    motion: list[Float[Tensor, ""]] = field(default_factory=list)
    static: Float[Tensor, ""] | None = None

    def fetch(self, norms: Mapping[str, Tensor]) -> Measured:
        """Copies the figures and the norms of the parameter groups' loss gradients to the host."""
        return Measured(
            [row for table in self.images for row in table.tolist()],
            [value for values in self.momentum for value in values.tolist()],
            sum(float(value) for value in self.motion),
            None if self.static is None else float(self.static),
            {name: float(norm) for name, norm in norms.items()},
        )


def relative(frames: Table, motion: float, baselines: Sequence[SequenceBaseline]) -> dict[str, float]:
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
