"""Penalty on mode mixing: keeps a trained template near the body's modes where the frames do not determine it."""

from __future__ import annotations

from gausim.training.terms.term import StepInputs


class MixingTerm:
    """Penalty on the template's mixing of modes, in units of the rest state's loss of each sequence."""

    def __init__(self, simulator: object) -> None:
        self._simulator = simulator

    def descend(self, step: StepInputs) -> None:
        """Backward pass over this rank's sequences; does nothing for a simulator without mixing."""
        weight, mixing_of = step.objective.mixing_weight, getattr(self._simulator, "mixing", None)
        if not weight or mixing_of is None:
            return
        for sample in step.samples:
            mixing = mixing_of(sample.scene_id)
            if mixing is not None and mixing.requires_grad:
                step.backward(weight / len(step.whole) * step.rest_loss(sample) * mixing)
