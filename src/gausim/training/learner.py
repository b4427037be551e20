"""What a step of the optimiser works on: the training module without Lightning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from gausim.core import SimState
from gausim.data.dataset import SequenceSample
from gausim.losses.objective import Objective
from gausim.runs.checkpoint import WeightAverage
from gausim.training.baseline_metrics import Baselines, SequenceBaseline
from gausim.training.contracts import SceneBatch, Simulator
from gausim.training.exchange import Exchange
from gausim.training.optimizers import OptimizerSettings
from gausim.training.ranks.ranks import Ranks
from gausim.training.supervision.images import Supervision
from gausim.training.terms.free_motion import FreeMotion
from gausim.training.terms.term import Term


@runtime_checkable
class Learner(Protocol):
    """The parts of a training.

    Attributes:
        objective: weights of the rollout's losses and how far gradients reach.
        settings: of the optimiser.
        supervision: what predictions are compared with.
        baselines: what the rest state scores.
        free_motion: the term that a rollout is continued for.
        diagonals: of the scenes [scene units].
        average: of the weights.
        ranks: who computes.
        exchange: makes the parts of the ranks the step of one.
        barren: steps in a row from which nothing was learned.
        shown: sequences of the last step.
    """

    objective: Objective
    settings: OptimizerSettings
    supervision: Supervision
    baselines: Baselines
    free_motion: FreeMotion
    diagonals: list[float]
    average: WeightAverage
    ranks: Ranks
    exchange: Exchange
    barren: int
    shown: int

    @property
    def simulator(self) -> Simulator:
        """The model, as what it can do."""

    def terms(self) -> Sequence[Term]:
        """Terms of the loss beside the rollout's, in the order of their backward passes."""

    def measures_fraction(self) -> bool:
        """Whether this step measures how much of the network's gradient is of the momentum loss."""

    def network(self) -> list[nn.Parameter]:
        """Weights of the network that learn."""

    def parameters(self) -> Iterator[nn.Parameter]:
        """All parameters."""

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """The same by name."""

    def initial(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> SimState:
        """x_0 and x_{-1} of the sequences of a batch."""

    def defers(self, device: torch.device) -> bool:
        """Whether reading a number would make the host wait; such reads are put off to the step's end."""

    def accumulate(self, loss: Tensor) -> None:
        """Adds the gradients of a loss to those of the parameters."""

    def baseline(self, sample: SequenceSample) -> SequenceBaseline:
        """What the rest state scores on a sample's sequence, for at least the sample's frames."""

    def rest_loss(self, sample: SequenceSample) -> float:
        """What the rest state scores on the frames of a sample, their mean: the unit of penalties."""
