"""What a term of the loss beside the rollout's own is given, and what it does with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.losses.objective import Objective
from gausim.training.ranks.ranks import Ranks
from gausim.training.statistics import Statistics
from gausim.training.supervision.images import ImageSupervision


@dataclass(frozen=True, eq=False)
class StepInputs:
    """One step of the optimiser, as its terms see it.

    ``samples`` are this rank's sequences and ``whole`` the facts of all ranks'; ``draws`` are the random numbers of the
    step. ``rest_loss`` is what the rest state scores on the frames of a sample, their mean: the unit of penalties.
    """

    samples: Sequence[SequenceSample]
    whole: Sequence[SampleFacts]
    draws: torch.Generator
    statistics: Statistics
    ranks: Ranks
    backward: Callable[[Tensor], None]
    rest_loss: Callable[[SequenceSample], float]
    objective: Objective
    images: ImageSupervision
    diagonals: Sequence[float]


@runtime_checkable
class Term(Protocol):
    """A term of the loss that does not need the rollout."""

    def descend(self, step: StepInputs) -> None:
        """Backward of the term, as the mean over all sequences of the step."""
