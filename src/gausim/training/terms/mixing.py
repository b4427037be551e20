"""Penalty on mode mixing: keeps a trained template near the body's modes where the frames do not determine it."""

from gausim.training.terms.term import StepInputs


def mixing_term(step: StepInputs) -> None:
    """Penalty on the template's mixing of modes, in units of the rest state's loss of each of this rank's sequences.

    It does nothing for a simulator without mixing.
    """
    weight, mixing_of = step.objective.mixing_weight, getattr(step.simulator, "mixing", None)
    if not weight or mixing_of is None:
        return
    for sample in step.samples:
        mixing = mixing_of(sample.scene_id)
        if mixing is not None and mixing.requires_grad:
            step.backward(weight / len(step.whole) * step.rest_loss(sample) * mixing)
