"""Predictions of a trained run, and selection of its objects and sequences."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, cast

from torch import Tensor

from gausim.compose.build import LoadedRun
from gausim.core import ConfigError, GaussianScene, SimState, Trajectory
from gausim.core.errors import DataError
from gausim.data.objects import ObjectData
from gausim.data.records import SequenceRecord
from gausim.evaluation.endurance import RandomPushes, endure
from gausim.evaluation.stability import largest_eigenvalue
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.runs.checkpoint import read_checkpoint
from gausim.runs.directory import RunDirectory

# Duration of the random pushes of `gausim evaluate --endurance` [frames].
PUSHED_FRAMES = 240


@dataclass(frozen=True)
class RunObject:
    """One object of a run."""

    scene_id: int  # index of the object in the run
    data: ObjectData  # data of the object
    first_sequence: int  # index of its first sequence over all objects


def run_objects(run: LoadedRun, names: list[str] | None = None) -> list[RunObject]:
    """The run's objects, or those of these names.

    Raises:
        DataError: the run has no object of such a name.
    """
    found, first = [], 0
    for scene_id, data in enumerate(run.objects):
        found.append(RunObject(scene_id, data, first))
        first += len(data.sequences)
    have = [item.data.name for item in found]
    unknown = [name for name in names or () if name not in have]
    if unknown:
        raise DataError(f"{run.run_dir}: has no object {unknown}; it has {have}.")
    return [item for item in found if names is None or item.data.name in names]


def sequence_of(item: RunObject, name: str) -> SequenceRecord:
    """A sequence of an object by its name.

    Raises:
        DataError: the object has no sequence of this name.
    """
    records = {record.name: record for record in item.data.sequences}
    if name not in records:
        raise DataError(f"{item.data.root}: has no sequence '{name}'; it has {list(records)}.")
    return records[name]


def scene_of(run: LoadedRun, item: RunObject) -> GaussianScene:
    """The rest scene that the run was trained on."""
    return run.module.scenes[item.scene_id]


def state_of(run: LoadedRun) -> dict[str, Any]:
    """Progress of the run: ``finished``, and ``epoch`` and ``updates`` of the checkpoint in use.

    Prints a warning to the standard error if the run is unfinished.
    """
    directory = RunDirectory(run.run_dir)
    if not directory.is_finished:
        print(f"warning: {run.run_dir} is not finished; its latest checkpoint is used.", file=sys.stderr)
    known = read_checkpoint(directory.checkpoint)
    return {"finished": directory.is_finished, "epoch": known.get("epoch"), "updates": known.get("global_step")}


class TrainedPrediction:
    """Predicts sequences of one object with the trained model, and caches them.

    Args:
        run: the loaded run.
        item: the object.
        frames: least number of frames to predict, also if the recording is shorter.
    """

    def __init__(self, run: LoadedRun, item: RunObject, *, frames: int = 0) -> None:
        self._run, self._item, self._frames = run, item, frames
        self._ids = {record.name: item.first_sequence + i for i, record in enumerate(item.data.sequences)}
        self._known: dict[str, Trajectory] = {}

    @property
    def levels(self) -> dict[str, Any] | None:
        """Units per level of the hierarchy, those predicted, N_F and N_K; None for a model without a hierarchy."""
        model: Any = self._run.module.model
        hierarchies = getattr(model, "hierarchies", None)
        if hierarchies is None:
            return None
        hierarchy, predicted = hierarchies[self._item.scene_id], list(model.predicted_levels)
        counts = [level.count for level in hierarchy.levels]
        predictions = hierarchy.predictions(predicted)
        return {"counts": counts, "predicted": predicted, "predictions": predictions, "kernels": counts[0]}

    @property
    def units(self) -> tuple[Tensor, ...]:
        """The unit of every kernel at each level, the finest first; empty for a model without a hierarchy."""
        units_of_kernels = getattr(self._run.module.model, "units_of_kernels", lambda scene_id: ())
        return tuple(units_of_kernels(self._item.scene_id))

    @property
    def footnotes(self) -> dict[str, Any] | None:
        """Remarks on the method (see :attr:`GausSimModule.footnotes`), with the largest eigenvalue of the step."""
        footnotes, model = self._run.module.footnotes, self._run.module.model
        if not isinstance(model, GausSim):
            return footnotes
        largest = largest_eigenvalue(model, self._item.scene_id)
        note = f"Largest eigenvalue of the step, linearised at rest: {largest:.4f}; small motions grow above 1."
        return {**footnotes, "largest_eigenvalue": largest, "notes": [*footnotes["notes"], note]}

    def __call__(self, record: SequenceRecord, frames: int | None = None) -> Trajectory:
        """The predicted first frames of a sequence, by default as many as recorded."""
        count = frames or record.count
        known = self._known.get(record.name)
        if known is None or known.frames < count:
            steps = max(record.count, self._frames, count) - 1
            known = self._known[record.name] = self._run.module.predict(self._ids[record.name], steps)
        return known.part(slice(count))


def endurance(run: LoadedRun, item: RunObject, frames: int) -> dict[str, Any]:
    """Long rollouts of an object: its first sequence without forces, and random pushes from rest."""
    if not isinstance(run.module.model, GausSim):
        raise ConfigError(
            f"--endurance: {run.module.method_name} takes no forces. Leave the option out, or evaluate a simulator."
        )
    scene, model, states = (
        scene_of(run, item).to(run.device),
        cast(Any, run.module.model),
        cast(Any, run.module.initial_states),
    )
    dynamics = SceneDynamics(model, item.scene_id)
    first, hands = states.state(item.first_sequence).detach(), cast(Any, run.module).method.hands(item.first_sequence)
    free = scene.simulated & ~scene.pinned
    pushes = RandomPushes(scene.means, dynamics.masses, free, scene.diagonal, item.data.fps, PUSHED_FRAMES)
    still = SimState(scene.means, scene.means)
    return {
        "free": endure(dynamics, first, scene.means, scene.diagonal, frames, hands=hands),
        "pushed": endure(dynamics, still, scene.means, scene.diagonal, frames, pushes=pushes),
    }
