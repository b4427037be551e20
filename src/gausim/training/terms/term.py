"""Inputs of a loss term that does not need the rollout."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.losses.objective import Objective
from gausim.training.contracts import Simulator
from gausim.training.ranks.ranks import Ranks
from gausim.training.statistics import Statistics
from gausim.training.supervision.images import ImageSupervision


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Inputs of the loss terms in one optimiser step.

    ``samples`` are this rank's sequences and ``whole`` describes those of all ranks; ``draws`` generates the step's
    random numbers. ``rest_loss`` is the mean loss of the rest state on the frames of a sample: the unit of penalties.
    """

    simulator: Simulator
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
