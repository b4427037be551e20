"""Initial states of sequences under a frozen model: Gauss and Newton's method in modal coordinates.

The coordinates z_t of the predicted frames, with the network, are compared with those of the tracked motion. Their
derivatives with respect to the amplitudes of z_{-1} are those of the template's step along the predicted motion
(:meth:`gausim.models.template.modal.ModalScene.derivatives`). The network's part is left out of them: it changes how
fast the method converges, and not to what.
"""

from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError
from gausim.models.initial_state import ModalInitialStates
from gausim.models.step.simulator import GausSim
from gausim.models.template.modal import ModalScene
from gausim.nn.mode import evaluating
from gausim.runs.bar import with_bar
from gausim.training.learner import Learner
from gausim.training.tracking import Track

# Steps of the method, and attempts at one of them; gain below which it ends.
STEPS, ATTEMPTS, LEAST_GAIN = 8, 4, 0.01
# Levenberg and Marquardt's damping in mean eigenvalues: its start, and factors after a success and a failure.
DAMPING, LESS, MORE = 1e-2, 0.1, 10.0


@torch.no_grad()
def fit_initial_states(learner: Learner, tracks: Sequence[Track], *, quiet: bool = False) -> None:
    """Fits the modal initial state of every sequence whose body is in no hands; the others keep the tracks' step."""
    left = []
    with evaluating(learner):
        for known in with_bar(tracks, "Fitting initial states", quiet=quiet):
            free_hand = learner.method.hands(known.sequence_id) is None
            if free_hand and isinstance(learner.initial_states, ModalInitialStates):
                left.append(_fitted(learner, learner.initial_states, known))
    if left:
        print(f"  initial states: {sum(left) / len(left):.3f} of the motion is left", flush=True)


def _fitted(learner: Learner, states: ModalInitialStates, known: Track) -> float:
    """Fits one sequence; returns the squared error over the squared motion."""
    model, number, scene_id = cast(GausSim, learner.model), known.sequence_id, known.scene_id
    projection = model.modal_projection(scene_id).flatten(0, 1)
    into = -projection.mT @ states.basis(number).flatten(0, 1)  # z_{-1} of amplitudes
    true, amplitudes = known.moved.flatten(1) @ projection, states.parameter(number)[: into.shape[1]]
    rest, size = model.scenes[scene_id].means.to(true), float(true.square().sum())

    def predicted() -> tuple[Tensor, float]:
        try:
            moved = learner.method.predict(number, len(true) - 1).positions - rest
        except DivergenceError:
            return true, torch.inf
        z = moved.flatten(1) @ projection
        return z, float((z - true).square().sum())

    (z, error), damping, part = predicted(), DAMPING, model.modal_scene(scene_id)
    for _ in range(STEPS):
        slopes = _slopes(torch.cat(((into @ amplitudes)[None], z)), part, into)
        normal, pull = slopes.mT @ slopes, slopes.mT @ (true - z)[1:].flatten()
        before, last, one = amplitudes.clone(), error, torch.eye(len(pull)).to(normal)
        for _ in range(ATTEMPTS):
            unit = damping * normal.diagonal().mean()
            amplitudes.copy_(before + torch.linalg.solve(normal + unit * one, pull))
            found, error = predicted()
            if error < last:
                z, damping = found, damping * LESS
                break
            amplitudes.copy_(before)
            error, damping = last, damping * MORE
        if error > (1 - LEAST_GAIN) * last:
            break
    return error / size


def _slopes(z: Float[Tensor, "F M"], part: ModalScene, into: Float[Tensor, "M P"]) -> Float[Tensor, "TM P"]:
    """Derivatives of z_1 .. z_T with respect to amplitudes; ``z`` begins with z_{-1}."""
    before, now, found = into, torch.zeros_like(into), []
    for previous, place, after in zip(z, z[1:], z[2:], strict=False):
        to_before, to_now = part.derivatives(previous[None], place[None], after[None])
        before, now = now, to_now[0] @ now + to_before[0] @ before
        found.append(now)
    return torch.cat(found)
