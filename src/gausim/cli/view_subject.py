"""From a run or a bare scene to what the viewer shows: interactions, recordings, videos, cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.compose.live import REST, energy_ceiling, open_interaction
from gausim.core import ConfigError, GaussianScene, SimState, Trajectory
from gausim.models.rollout.dynamics import SceneDynamics

if TYPE_CHECKING:
    from gausim.compose.build import LoadedRun
    from gausim.compose.predict import RunObject, TrainedPrediction
    from gausim.interaction.interaction import Interaction
    from gausim.viewer.companion import Companion
    from gausim.viewer.shown import Take
    from gausim.viewer.subject import Subject

# The model of a bare scene: untrained, its network is silent and the elastic template moves the object alone.
BARE_MODEL = "gausim"


@dataclass(frozen=True, eq=False)
class Playable:
    """A method, bound to one object.

    Attributes:
        interaction: what is pushed.
        predict: what it foresees of the recorded sequences; None for a bare scene.
        item: the run's object; None for a bare scene.
        run: the run; None for a bare scene.
    """

    interaction: Interaction
    predict: TrainedPrediction | None = None
    item: RunObject | None = None
    run: LoadedRun | None = None


def playable_run(
    run: LoadedRun,
    *,
    name: str | None = None,
    sequence: str = REST,
    gravity: float | None = None,
    keep: int | None = 0,
) -> Playable:
    """The object of a run.

    Args:
        run: the loaded run.
        name: of the object; the first one when None.
        sequence: whose beginning is the initial state, or ``rest``.
        gravity: acceleration that makes a weight of a mass [scene units / s^2].
        keep: so many of the latest frames are kept; None keeps all.

    Raises:
        DataError: there is no such object or sequence.
        ConfigError: the model cannot be simulated on its own.
    """
    from gausim.compose.predict import TrainedPrediction, run_objects

    item = run_objects(run, [name] if name is not None else None)[0]
    interaction = open_interaction(run, name=name, sequence=sequence, gravity=gravity, keep=keep)
    return Playable(interaction, TrainedPrediction(run, item), item, run)


def playable_scene(
    scene: GaussianScene, *, fps: float, seed: int, gravity: float | None = None, keep: int | None = 0
) -> Playable:
    """A scene without a run: the elastic template of the default model, its network silent.

    Raises:
        SceneError: nothing is pinned.
        ConfigError: the frame rate is not positive and finite.
    """
    import torch

    from gausim.compose.config import compose, instantiate
    from gausim.interaction.interaction import STANDARD_GRAVITY, Interaction
    from gausim.interaction.session import MadeWith
    from gausim.ops.selection import require_pinned

    if not (math.isfinite(fps) and fps > 0):
        raise ConfigError(f"--fps {fps}: expected frames per second > 0.")
    require_pinned(scene)
    torch.manual_seed(seed)
    model = instantiate(compose(f"model/{BARE_MODEL}").model.simulator)(scenes=[scene], fps=[fps])
    dynamics, initial = SceneDynamics(model), SimState(scene.means, scene.means)
    dynamics.energy_ceiling = energy_ceiling(model, 0, ())
    made_with = MadeWith.of(scene, model, initial, settings=BARE_MODEL, run="untrained")
    interaction = Interaction(
        scene, dynamics, dynamics.masses, initial, made_with=made_with, units=tuple(model.units_of_kernels(0)),
        gravity=STANDARD_GRAVITY if gravity is None else gravity, keep=keep,
    )  # fmt: skip
    return Playable(interaction)


def takes_of(made: Playable, beside: Playable | None, frames: int | None) -> list[Take]:
    """The recorded sequences as the method foresees them, each made when it is first shown."""
    from gausim.viewer.shown import Take

    if made.predict is None or made.item is None:
        return []
    other: dict[str, Any] = {}
    if beside is not None and beside.item is not None:
        other = {record.name: record for record in beside.item.data.sequences}
    takes = []
    for record in made.item.data.sequences:
        second = None
        if beside is not None and beside.predict is not None and record.name in other:
            second = partial(_predicted, beside.predict, other[record.name], frames)
        first = partial(_predicted, made.predict, record, frames)
        takes.append(Take(f"Predicted: {record.name}", first, record.name, second))
    return takes


def _predicted(predict: TrainedPrediction, record: Any, frames: int | None) -> Trajectory:
    from gausim.compose.predict import head

    return head(predict.full(record), frames or record.count)


def companion_of(made: Playable, name: str) -> Companion:
    """A method to stand beside another."""
    from gausim.viewer.companion import Companion

    return Companion(name, made.interaction)


def subject_of(made: Playable, *, title: str, beside: Playable | None, up: str, sessions: Path) -> Subject:
    """Everything the viewer shows."""
    from gausim.viewer.films import Films
    from gausim.viewer.subject import Subject

    films = cameras = None
    if made.run is not None and made.item is not None:
        records = {record.name: record for record in made.item.data.sequences}
        films = Films(records, made.interaction.scene, made.run.renderer)
        cameras = next(iter(records.values())).cameras
    return Subject(
        title=title, interaction=made.interaction, takes=takes_of(made, beside, None),
        companion=None if beside is None else companion_of(beside, _name_of(beside)), films=films, cameras=cameras,
        up=up, sessions=sessions,
    )  # fmt: skip


def _name_of(made: Playable) -> str:
    if made.run is None:
        return "untrained"
    return f"{made.run.module.method_name} ({Path(made.run.run_dir).name})"
