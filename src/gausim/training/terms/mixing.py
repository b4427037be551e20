"""The penalty on mode mixing: what the frames do not tell of a trained template stays as the body was."""

from __future__ import annotations

from gausim.training.terms.term import StepInputs


class MixingTerm:
    """The template's mixing of modes, for each sequence in units of its rest state's loss."""

    def __init__(self, simulator: object) -> None:
        self._simulator = simulator

    def descend(self, step: StepInputs) -> None:
        """Backward of the sequences of this rank; there is none where the simulator mixes nothing."""
        weight, mixing_of = step.objective.mixing_weight, getattr(self._simulator, "mixing", None)
        if not weight or mixing_of is None:
            return
        for sample in step.samples:
            mixing = mixing_of(sample.scene_id)
            if mixing is not None and mixing.requires_grad:
                step.backward(weight / len(step.whole) * step.rest_loss(sample) * mixing)
