"""The first stage of a training: the motion of all sequences, from the images or from true points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from jaxtyping import Float
from torch import Tensor

from gausim.data.datamodule import ReadyDataModule
from gausim.data.records import GroundTruth
from gausim.models.step.simulator import GausSim
from gausim.runs.bar import with_bar
from gausim.training.learner import Learner
from gausim.training.plan import TrainingPlan
from gausim.training.supervision.images import Sources
from gausim.training.supervision.motion_tracks import TrackSupervision
from gausim.training.supervision.points import PointSupervision, attach_points


@dataclass(frozen=True, eq=False)
class Track:
    """The motion of one sequence in its seen frames."""

    scene_id: int  # index of the object
    sequence_id: int  # number of the sequence over all objects
    moved: Float[Tensor, "F K 3"]  # displacements of all kernels from rest, frame 0 first [scene units]


def track(learner: Learner, data: ReadyDataModule, *, quiet: bool = False) -> list[Track]:
    """Tracks every training sequence, sets its initial state to the first step, and says how far the tracks are off.

    The modes are those of the model's template (:meth:`gausim.models.template.template.Template.basis`).
    """
    model, last = cast(GausSim, learner.model), cast(TrainingPlan, data.plan).t_max or 1
    tracks, states, device = learner.supervision, learner.method.states, next(model.parameters()).device
    if not isinstance(tracks, PointSupervision):
        motions, image, references = model.smooth_motions, learner.objective.image, learner.method.references
        tracks = TrackSupervision(
            Sources(model.scenes, lambda number: None, motions, learner.renderer, image, references)
        )
    found = []
    for number in with_bar(range(len(data.index.entries)), "Tracking the motion", quiet=quiet):
        sample = data.training_sample(number, last).to(device)
        found.append(Track(sample.scene_id, number, tracks.displacements(sample).to(device)))
        states.set_motion(number, found[-1].moved[1])
    print(f"  track: {_told(learner, data, found)}", flush=True)
    return found


def _told(learner: Learner, data: ReadyDataModule, tracks: Sequence[Track]) -> str:
    """How many sequences were tracked and, of those whose true motion is known, the error."""
    errors = []
    for known in tracks:
        number = known.sequence_id
        sealed = data.index.entries[number][1].limit is not None
        truth = None if sealed else data.index.ground_truth(number)
        if truth is not None and learner.method.hands(number) is None:
            errors.append(track_error(learner, known, truth))
    sequences = f"{len(tracks)} sequence{'s' if len(tracks) != 1 else ''}"
    if not errors:
        return sequences
    mean = sum(errors) / len(errors)
    return f"{sequences}; of the {len(errors)} whose true motion is known, {mean:.3f} of it is missed"


def track_error(learner: Learner, known: Track, truth: GroundTruth) -> float:
    """Mean error of a track's points over their mean displacement, in the frames after the first."""
    scene = learner.simulator.scenes[known.scene_id]
    kernels = attach_points(scene, truth.rest)
    true = (truth.positions[1 : len(known.moved)] - truth.rest).to(known.moved)
    off = known.moved[1:, kernels.to(known.moved.device)] - true
    return float(off.norm(dim=-1).mean() / true.norm(dim=-1).mean().clamp_min(1e-12))
