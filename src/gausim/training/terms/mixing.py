"""The penalty on mode mixing: what the frames do not tell of a trained template stays as the body was."""

from __future__ import annotations

from gausim.training.contracts import Mixing
from gausim.training.terms.term import StepInputs


class MixingTerm:
    """The template's mixing of modes, for each sequence in units of its rest state's loss."""

    def __init__(self, simulator: object) -> None:
        """A simulator that mixes nothing has no such term."""
        self._mixing = simulator if isinstance(simulator, Mixing) else None

    def descend(self, step: StepInputs) -> None:
        """Backward of the sequences of this rank."""
        weight = step.objective.mixing_weight
        if not weight or self._mixing is None:
            return
        for sample in step.samples:
            mixing = self._mixing.mixing(sample.scene_id)
            if mixing is not None and mixing.requires_grad:
                step.backward(weight / len(step.whole) * step.rest_loss(sample) * mixing)
