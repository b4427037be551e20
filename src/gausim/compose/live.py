"""Interactive objects of runs, for `simulate`, `view` and the Python interface."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from torch import Tensor

    from gausim.compose.build import LoadedRun
    from gausim.compose.predict import RunObject
    from gausim.core import GaussianScene, HandPath, SimState, Steppable
    from gausim.interaction.interaction import Interaction

REST = "rest"
# Limit of the energy from forces, as a multiple of the initial energy of recorded motions; training covers little more.
ENERGY_ROOM = 2.0
# Least speed of the motion that defines the limit of energy [diagonals per frame of the farthest kernel].
_LEAST_SWAY = 0.02


def open_interaction(
    run: LoadedRun,
    *,
    name: str | None = None,
    sequence: str = REST,
    gravity: float | None = None,
    most_force: float | None = None,
    seed: int = 0,
    keep: int | None = 0,
) -> Interaction:
    """Opens an object of a run for interaction.

    Args:
        run: the loaded run.
        name: name of the object; the first one when None.
        sequence: sequence that gives the initial state, or ``rest``.
        gravity: acceleration that defines the unit of weight [scene units / s^2]; 9.81 when None.
        most_force: the largest force [weights]; the default of interactions when None.
        seed: seed of the gusts of wind.
        keep: number of latest frames to keep; None keeps all.

    Raises:
        DataError: the object or sequence does not exist.
        ConfigError: the model does not support simulation.
    """
    from gausim.compose.predict import TrainedPrediction, run_objects, scene_of
    from gausim.interaction.interaction import MOST_FORCE, STANDARD_GRAVITY, Interaction
    from gausim.interaction.session import MadeWith

    item = run_objects(run, None if name is None else [name])[0]
    scene = scene_of(run, item)
    initial, dynamics, masses, ceiling, path = _method(run, item, scene, sequence)
    settings = json.dumps([run.config.get("model"), ceiling], sort_keys=True, default=str)
    made_with = MadeWith.of(
        scene, run.module.model, initial, settings=settings, name=sequence, run=_name(Path(run.run_dir)), path=path
    )
    return Interaction(
        scene,
        dynamics,
        masses,
        initial,
        made_with=made_with,
        units=TrainedPrediction(run, item).units,
        gravity=STANDARD_GRAVITY if gravity is None else gravity,
        most_force=MOST_FORCE if most_force is None else most_force,
        seed=seed,
        keep=keep,
        hands=None if path is None else path.pose,
    )


def energy_ceiling(model: object, scene_id: int, previous: Sequence[Tensor]) -> float | None:
    """The energy that forces may give a scene: :data:`ENERGY_ROOM` times the largest initial energy.

    Args:
        model: the simulator.
        scene_id: index of the scene.
        previous: positions one frame before rest of every recorded sequence; may be empty.

    Returns:
        The energy; None for models without an energy.
    """
    import torch

    from gausim.core import SimState
    from gausim.core.state import initial_sway

    if not getattr(model, "knows_energy", False):
        return None
    simulator = cast(Any, model)
    scene, batch = simulator.scenes[scene_id], simulator.batch((scene_id,))
    rest = batch.rest
    states = [initial_sway(scene, _LEAST_SWAY).previous, *previous]
    with torch.no_grad():
        energies = [float(simulator.energy(batch, SimState(rest, x.to(rest)))) for x in states]
    return ENERGY_ROOM * max(energies)


def _method(
    run: LoadedRun, item: RunObject, scene: GaussianScene, sequence: str
) -> tuple[SimState, Steppable, Tensor, float | None, HandPath | None]:
    """Initial state, dynamics, masses, the limit of the energy, and the recorded path of the hands."""
    from gausim.core import FittedDynamics, SimState
    from gausim.models.rollout.dynamics import scene_dynamics
    from gausim.models.step.simulator import GausSim
    from gausim.ops.covariance import kernel_volumes
    from gausim.training.fitted.fitting import StagedFit

    module, names = run.module, [record.name for record in item.data.sequences]
    if sequence != REST and sequence not in names:
        raise DataError(f"{item.data.root}: has no sequence '{sequence}'; expected '{REST}' or one of {names}.")
    number = item.first_sequence + (names.index(sequence) if sequence != REST else 0)
    if isinstance(module.method, StagedFit):
        volumes = kernel_volumes(scene.log_scales, scene.volume_scale) * scene.simulated
        return SimState(scene.means, scene.means), FittedDynamics(module.method.fitted, number), volumes, None, None
    if not isinstance(module.model, GausSim):
        raise ConfigError(f"{run.run_dir}: {module.method_name} cannot be simulated by itself. Take a run of gausim.")
    states = cast(Any, module.initial_states)
    numbers = range(item.first_sequence, item.first_sequence + len(names))
    starts = [states.state(i).detach() for i in numbers]
    ceiling = energy_ceiling(module.model, item.scene_id, [start.previous.to(scene.means) for start in starts])
    dynamics = scene_dynamics(module.model, item.scene_id, energy_ceiling=ceiling)
    initial = SimState(scene.means, scene.means) if sequence == REST else starts[names.index(sequence)]
    path = None if sequence == REST else item.data.sequences[names.index(sequence)].hands
    return initial, dynamics, dynamics.masses, ceiling, path


def _name(path: Path) -> str:
    """Name of a run: its last two folders, as the last one is often only the seed."""
    return "/".join(path.resolve().parts[-2:])
