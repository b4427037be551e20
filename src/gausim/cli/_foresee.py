"""What `evaluate` and `simulate` share: predictions of a trained run, its facts, choices of objects and views."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from gausim.core.errors import DataError

if TYPE_CHECKING:
    from gausim.cli._run import LoadedRun
    from gausim.core import Dynamics, GaussianScene, Trajectory
    from gausim.data.objects import ObjectData
    from gausim.data.records import SequenceRecord

GAUSSIM = "gausim"


def method_of(run: LoadedRun) -> str:
    """What the run's predictions are called in tables."""
    from gausim.engine.fitting import FittedModule

    return run.module.method.name if isinstance(run.module, FittedModule) else GAUSSIM


@dataclass(frozen=True)
class RunObject:
    """One object of a run.

    Attributes:
        scene_id: its index in the run.
        data: its sequences.
        first_sequence: running number of its first sequence over all objects.
    """

    scene_id: int
    data: ObjectData
    first_sequence: int


def run_objects(run: LoadedRun, names: list[str] | None = None) -> list[RunObject]:
    """The run's objects, or those of these names.

    Raises:
        DataError: the run has no object of a name.
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


def scene_of(run: LoadedRun, item: RunObject) -> GaussianScene:
    """The rest scene that the run was trained on."""
    return run.module.simulator.scenes[item.scene_id]


def state_of(run: LoadedRun) -> dict[str, Any]:
    """How far the run has come: ``finished``, ``epoch`` and ``updates`` of the checkpoint in use.

    An unfinished run is said to be so on the standard error.
    """
    from gausim.engine.checkpoint import read_checkpoint
    from gausim.engine.run import RunDirectory

    directory = RunDirectory(run.run_dir)
    if not directory.is_finished:
        print(f"warning: {run.run_dir} is not finished; its latest checkpoint is used.", file=sys.stderr)
    checkpoint = read_checkpoint(directory.checkpoint)
    return {
        "finished": directory.is_finished,
        "epoch": checkpoint.get("epoch"),
        "updates": checkpoint.get("global_step"),
    }


class TrainedPrediction:
    """Predicts sequences of one object with the trained model, each once.

    Args:
        run: the loaded run.
        item: the object.
        frames: frames to predict at least, also where the recording is shorter.
    """

    def __init__(self, run: LoadedRun, item: RunObject, *, frames: int = 0) -> None:
        self._run, self._item, self._frames = run, item, frames
        names = [record.name for record in item.data.sequences]
        self._ids = {name: item.first_sequence + i for i, name in enumerate(names)}
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
    def footnotes(self) -> dict[str, Any] | None:
        """Whether it extrapolates, and what a reader must know; None for a simulator, of which all is in its config."""
        from gausim.engine.fitting import FittedModule

        module = self._run.module
        if not isinstance(module, FittedModule):
            return None
        return {"extrapolates": module.method.extrapolates, "notes": module.notes(), "fit": dict(module.cost)}

    def full(self, record: SequenceRecord) -> Trajectory:
        """All predicted frames of a sequence, the recorded ones and those asked for beyond."""
        if record.name not in self._known:
            steps = max(record.count, self._frames) - 1
            self._known[record.name] = self._predict(self._ids[record.name], steps)
        return self._known[record.name]

    def _predict(self, sequence_id: int, steps: int) -> Trajectory:
        import torch

        from gausim.core import SimState
        from gausim.engine.fitting import FittedModule

        module = self._run.module
        if isinstance(module, FittedModule):
            return module.foresee(sequence_id, steps)
        # The parts of a run are torch modules; what they offer beyond that is stated by the engine's contracts.
        model: Any = module.model
        states: Any = module.initial_states
        rest = scene_of(self._run, self._item).means
        with torch.no_grad():
            previous = states.previous(sequence_id).to(rest)
        dynamics: Dynamics = model.dynamics(self._item.scene_id)
        return dynamics.rollout(SimState(rest, previous), steps)

    def __call__(self, record: SequenceRecord) -> Trajectory:
        """Exactly the recorded frames of a sequence."""
        return head(self.full(record), record.count)


def head(trajectory: Trajectory, frames: int) -> Trajectory:
    """The first frames of a trajectory."""
    return replace(
        trajectory,
        positions=trajectory.positions[:frames],
        gradients=trajectory.gradients[:frames],
        rotations=trajectory.rotations[:frames],
    )


def progress(total: int, title: str) -> tuple[Any, Callable[[str], None]]:
    """A progress bar (a context manager, on the standard error) and what advances it by one named item."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(title, total=total)

    def advance(name: str) -> None:
        bar.update(task, advance=1, description=f"{title}: {name}")

    return bar, advance
