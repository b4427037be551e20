"""Objects of a trained run and predictions of their sequences."""

import sys
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from gausim.compose.build import LoadedRun
from gausim.core import GaussianScene, Trajectory
from gausim.core.errors import DataError
from gausim.data.objects import ObjectData
from gausim.data.records import SequenceRecord
from gausim.runs.checkpoint import read_checkpoint
from gausim.runs.directory import RunDirectory


@dataclass(eq=False)
class RunObject:
    """One object of a run; called with a sequence, it predicts that with the trained model, and keeps the result."""

    run: LoadedRun
    scene_id: int  # index of the object in the run
    data: ObjectData  # data of the object
    first_sequence: int  # index of its first sequence over all objects
    least_frames: int = 0  # number of frames that are predicted at least, also if the recording is shorter
    _known: dict[str, Trajectory] = field(default_factory=dict)

    @property
    def scene(self) -> GaussianScene:
        """The rest scene that the run was trained on."""
        return self.run.module.scenes[self.scene_id]

    @property
    def levels(self) -> dict[str, Any] | None:
        """Units per level of the hierarchy, those predicted, N_F and N_K; None for a model without a hierarchy."""
        model: Any = self.run.module.model
        hierarchies = getattr(model, "hierarchies", None)
        if hierarchies is None:
            return None
        hierarchy, predicted = hierarchies[self.scene_id], list(model.predicted_levels)
        counts = [level.count for level in hierarchy.levels]
        predictions = hierarchy.predictions(predicted)
        return {"counts": counts, "predicted": predicted, "predictions": predictions, "kernels": counts[0]}

    @property
    def units(self) -> tuple[Tensor, ...]:
        """The unit of every kernel at each level, the finest first; empty for a model without a hierarchy."""
        units_of_kernels: Any = getattr(self.run.module.model, "units_of_kernels", lambda scene_id: ())
        return tuple(units_of_kernels(self.scene_id))

    @property
    def footnotes(self) -> dict[str, Any]:
        """Remarks on the method (see :attr:`GausSimModule.footnotes`)."""
        return self.run.module.footnotes

    def sequence(self, name: str) -> SequenceRecord:
        """A sequence by its name.

        Raises:
            DataError: the object has no sequence of this name.
        """
        records = {record.name: record for record in self.data.sequences}
        if name not in records:
            raise DataError(f"{self.data.root}: has no sequence '{name}'; it has {list(records)}.")
        return records[name]

    def __call__(self, record: SequenceRecord, frames: int | None = None) -> Trajectory:
        """The predicted first frames of a sequence, by default as many as recorded."""
        count = frames or record.count
        known = self._known.get(record.name)
        if known is None or known.frames < count:
            place = [own.name for own in self.data.sequences].index(record.name)
            steps = max(record.count, self.least_frames, count) - 1
            known = self._known[record.name] = self.run.module.predict(self.first_sequence + place, steps)
        return known.part(slice(count))


def run_objects(run: LoadedRun, names: list[str] | None = None) -> list[RunObject]:
    """The run's objects, or those of these names.

    Raises:
        DataError: the run has no object of such a name.
    """
    found, first = [], 0
    for scene_id, data in enumerate(run.objects):
        found.append(RunObject(run, scene_id, data, first))
        first += len(data.sequences)
    have = [item.data.name for item in found]
    unknown = [name for name in names or () if name not in have]
    if unknown:
        raise DataError(f"{run.run_dir}: has no object {unknown}; it has {have}.")
    return [item for item in found if names is None or item.data.name in names]


def run_object(run: LoadedRun, name: str | None = None) -> RunObject:
    """The run's object of this name, or its first one; errors are those of :func:`run_objects`."""
    return run_objects(run, None if name is None else [name])[0]


def state_of(run: LoadedRun) -> dict[str, Any]:
    """Progress of the run: ``finished``, and ``epoch`` and ``updates`` of the checkpoint in use.

    Prints a warning to the standard error if the run is unfinished.
    """
    directory = RunDirectory(run.run_dir)
    if not directory.is_finished:
        print(f"warning: {run.run_dir} is not finished; its latest checkpoint is used.", file=sys.stderr)
    known = read_checkpoint(directory.checkpoint)
    return {"finished": directory.is_finished, "epoch": known.get("epoch"), "updates": known.get("global_step")}
