"""A scene without videos: moved by the network of a trained run and a chosen material, or by the template alone."""

import math
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from gausim.compose.config import compose, instantiate
from gausim.compose.device import find_device
from gausim.compose.live import energy_ceiling
from gausim.core import GaussianScene, SimState
from gausim.core.errors import ConfigError
from gausim.core.state import initial_sway
from gausim.interaction.interaction import STANDARD_GRAVITY, Interaction
from gausim.interaction.session import MadeWith
from gausim.models.rollout.dynamics import scene_dynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import REFERENCE_FPS, MaterialTemplate
from gausim.ops.selection import require_pinned
from gausim.runs.directory import RunDirectory
from gausim.training.transfer import load_shared

# The model without a trained run: its untrained network outputs zero, so that only the template acts.
UNTRAINED = "gausim"
# Corrections of the stiffness, to which the decoders add a little that depends on it.
ROUNDS = 6


def open_scene(
    scene: GaussianScene,
    *,
    fps: float,
    base: Path | None = None,
    stiffness: float | None = None,
    damping: float | None = None,
    seed: int = 0,
    sway: float = 0.0,
    gravity: float | None = None,
    keep: int | None = 0,
    device: str = "cpu",
) -> Interaction:
    """Opens a scene without videos, some of its kernels pinned, for interaction.

    ``base`` is a trained run of the neural simulator whose network and decoders move it; None: an untrained model of
    this ``seed``. The material is the same everywhere: ``stiffness`` is over that of the material whose slowest swing
    takes one second (1), amplitudes fall as exp(-``damping`` t / 2) [1 / s] (0.5); without a base and both it is the
    reference material. ``sway`` is the initial displacement per frame of the kernel farthest from the pins [diagonals],
    ``gravity`` the unit of weight [scene units / s^2] (9.81), ``keep`` the number of latest frames that are kept
    (None: all), ``device`` as for :func:`gausim.compose.device.find_device`.

    Raises:
        SceneError: no kernel is pinned.
        ConfigError: there is no such device, a number is not positive and finite, or ``base`` is a run of another
            model.
    """
    for name, value in (("fps", fps), ("stiffness", stiffness), ("damping", damping)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ConfigError(f"--{name} {value:g}: expected a number > 0.")
    require_pinned(scene)
    torch.manual_seed(seed)
    if base is None:
        model = _built(compose([f"model={UNTRAINED}"]).model.simulator, scene, fps)
    else:
        model = _of_base(scene, fps, base)
    if base is not None or stiffness is not None or damping is not None:
        _give_material(model, period=(stiffness or 1.0) ** -0.5, damping=damping or 0.5)
    place, swaying = find_device(device), initial_sway(scene, sway)
    initial = SimState(swaying.positions.to(place), swaying.previous.to(place))
    model = model.to(place)
    dynamics = scene_dynamics(model, energy_ceiling=energy_ceiling(model, 0, [initial.previous]))
    run = "untrained" if base is None else base.resolve().name
    made_with = MadeWith.of(scene, model, initial, settings=UNTRAINED, run=run)
    return Interaction(
        scene, dynamics, dynamics.masses, initial, made_with=made_with, units=tuple(model.units_of_kernels(0)),
        gravity=STANDARD_GRAVITY if gravity is None else gravity,
        keep=keep,
    )  # fmt: skip


def _of_base(scene: GaussianScene, fps: float, base: Path) -> GausSim:
    """The simulator of a run's configuration with its shared weights."""
    config = RunDirectory(base).config().get("model", {})
    node = OmegaConf.create(config).get("simulator")
    model = None if node is None else _built(node, scene, fps)
    if model is None or not isinstance(model.template, MaterialTemplate):
        raise ConfigError(
            f"--from {base}: expected a run of the neural simulator (model=gausim), whose attributes are stiffness and "
            "damping."
        )
    load_shared(model, base, config)
    model.freeze(scenes=True)
    return model.eval()


def _built(node: Any, scene: GaussianScene, fps: float) -> GausSim:
    return cast("GausSim", instantiate(node, scenes=[scene], fps=[fps])())


@torch.no_grad()
def _give_material(model: GausSim, *, period: float, damping: float) -> None:
    """Gives the only scene a material that is the same everywhere.

    Attribute 0 is the logarithm of the stiffness over that of the template's reference material. That ratio follows
    from the ``period`` of the slowest mode [s], since the matrices of the template are known. Attribute 1 is the
    logarithm of the ``damping`` [1 / s] over the reference's.
    """
    template, batch = cast("MaterialTemplate", model.template), model.batch((0,))
    attributes = model.attributes[0].zero_()
    attributes[:, 1] = math.log(damping / (REFERENCE_FPS * math.exp(template.log_drag)))
    for _ in range(ROUNDS):
        unit = model.units(batch)[-1][-1]
        made = template.slowest_period(0, unit.log_density, unit.attributes)
        attributes[:, 0] += 2 * math.log(made / period)
