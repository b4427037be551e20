"""Interactive objects of runs, for `simulate`, `view` and the Python interface."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from gausim.baselines.fitting import FittedModule
from gausim.compose.build import LoadedRun
from gausim.compose.predict import RunObject, run_object
from gausim.core import ConfigError, DataError, HandPath, SimState, Steppable
from gausim.core.state import initial_sway
from gausim.interaction.interaction import MOST_FORCE, STANDARD_GRAVITY, Interaction
from gausim.interaction.session import MadeWith
from gausim.models.rollout.dynamics import scene_dynamics
from gausim.models.step.simulator import GausSim
from gausim.ops.covariance import kernel_volumes

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
    keep: int | None = 0,
) -> Interaction:
    """Opens an object of a run for interaction, the first one where no ``name`` is given.

    ``sequence`` gives the initial state, or is ``rest``; ``gravity`` is the unit of weight [scene units / s^2] (9.81),
    ``most_force`` the largest force [weights], ``keep`` the number of latest frames that are kept (None: all).

    Raises:
        DataError: the object or sequence does not exist.
        ConfigError: the model does not support simulation.
    """
    item = run_object(run, name)
    initial, dynamics, masses, ceiling, path = _method(item, sequence)
    settings = json.dumps([run.config.get("model"), ceiling], sort_keys=True, default=str)
    name_of_run = "/".join(Path(run.run_dir).resolve().parts[-2:])  # the last folder alone is often only the seed
    made_with = MadeWith.of(
        item.scene, run.module.model, initial, settings=settings, name=sequence, run=name_of_run, path=path
    )
    return Interaction(
        item.scene, dynamics, masses, initial, made_with=made_with, units=item.units,
        gravity=STANDARD_GRAVITY if gravity is None else gravity,
        most_force=MOST_FORCE if most_force is None else most_force, keep=keep,
        hands=None if path is None else path.pose,
    )  # fmt: skip


def energy_ceiling(model: object, scene_id: int, previous: Sequence[Tensor]) -> float | None:
    """The energy that forces may give a scene: :data:`ENERGY_ROOM` times the largest initial energy.

    ``previous`` are the positions one frame before rest of every recorded sequence, if any. None for models without an
    energy.
    """
    if not getattr(model, "knows_energy", False):
        return None
    simulator = cast(Any, model)
    scene, batch = simulator.scenes[scene_id], simulator.batch((scene_id,))
    rest = batch.rest
    states = [initial_sway(scene, _LEAST_SWAY).previous, *previous]
    with torch.no_grad():
        energies = [float(simulator.energy(batch, SimState(rest, x.to(rest)))) for x in states]
    return ENERGY_ROOM * max(energies)


def _method(item: RunObject, sequence: str) -> tuple[SimState, Steppable, Tensor, float | None, HandPath | None]:
    """Initial state, dynamics, masses, the limit of the energy, and the recorded path of the hands."""
    run, module, scene = item.run, item.run.module, item.scene
    rest = scene.means.to(run.device)
    still = SimState(rest, rest)
    names = [record.name for record in item.data.sequences]
    if sequence != REST and sequence not in names:
        raise DataError(f"{item.data.root}: has no sequence '{sequence}'; expected '{REST}' or one of {names}.")
    index = 0 if sequence == REST else names.index(sequence)
    if isinstance(module, FittedModule):
        volumes = kernel_volumes(scene.log_scales, scene.volume_scale) * scene.simulated
        return still, module.dynamics(item.first_sequence + index), volumes, None, None
    if not isinstance(module.model, GausSim):
        raise ConfigError(f"{run.run_dir}: {module.method_name} cannot be simulated by itself. Take a run of gausim.")
    states = cast(Any, module.initial_states)
    starts = [states.state(item.first_sequence + i).detach() for i in range(len(names))]
    ceiling = energy_ceiling(module.model, item.scene_id, [start.previous.to(scene.means) for start in starts])
    dynamics = scene_dynamics(module.model, item.scene_id, energy_ceiling=ceiling)
    if sequence == REST:
        return still, dynamics, dynamics.masses, ceiling, None
    return starts[index], dynamics, dynamics.masses, ceiling, item.data.sequences[index].hands
