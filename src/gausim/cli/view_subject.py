"""Content of the viewer for a run or a bare scene: interactions, predictions, cameras."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

from gausim.compose.build import LoadedRun
from gausim.compose.live import REST, open_interaction
from gausim.compose.predict import RunObject, run_object
from gausim.core import Trajectory
from gausim.interaction.interaction import Interaction
from gausim.models.step.scene_model import SceneModel
from gausim.models.template.template import Property
from gausim.viewer.live import Companion
from gausim.viewer.shown import Take
from gausim.viewer.subject import Subject


class Playable(NamedTuple):
    """A method for one object."""

    interaction: Interaction  # the interactive simulation of the object
    item: RunObject | None = None  # the object of the run; None for a bare scene

    def predictions(self) -> dict[str, Callable[[], Trajectory]]:
        """Functions that predict the recorded sequences, by name."""
        records = [] if self.item is None else self.item.data.sequences
        return {record.name: partial(cast(RunObject, self.item), record) for record in records}


def playable_run(
    run: LoadedRun, *, name: str | None = None, sequence: str = REST, gravity: float | None = None, keep: int | None = 0
) -> Playable:
    """An object of a run, by default its first; the options are those of :func:`open_interaction`."""
    interaction = open_interaction(run, name=name, sequence=sequence, gravity=gravity, keep=keep)
    return Playable(interaction, run_object(run, name))


def subject_of(made: Playable, *, title: str, beside: Playable | None, up: str, sessions: Path) -> Subject:
    """The complete content of the viewer."""
    cameras = companion = None
    material: dict[str, Property] = {}
    other = {} if beside is None else beside.predictions()
    takes = [Take(f"Predicted: {name}", load, other.get(name)) for name, load in made.predictions().items()]
    if made.item is not None:
        run = made.item.run
        cameras = made.item.data.sequences[0].cameras
        if isinstance(run.module.model, SceneModel):
            material = run.module.model.material(made.item.scene_id)
    if beside is not None and beside.item is not None:
        run = beside.item.run
        companion = Companion(f"{run.module.method_name} ({Path(run.run_dir).name})", beside.interaction)
    return Subject(
        title=title, interaction=made.interaction, takes=takes, companion=companion, cameras=cameras,
        material=material, up=up, sessions=sessions,
    )  # fmt: skip
