"""Losses of the static prediction on each training sequence, and the squared change of the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from torch import Tensor

from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.training.supervision.images import Supervision


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
