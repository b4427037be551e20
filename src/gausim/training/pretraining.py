"""Training on bodies whose motion, and where given whose material, is known."""

import math
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, SimState
from gausim.data.corpus import CorpusBody
from gausim.data.pretraining import CorpusDataModule
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import REFERENCE_FPS, MaterialTemplate
from gausim.training.contracts import Simulator
from gausim.training.method import SharedSimulator

# Damping below which it is not told apart from none [of the reference's].
LEAST_DAMPING = 1e-3
# Corrections of the stiffness, to which the decoders add a little that depends on it.
ROUNDS = 6


class KnownStates(SharedSimulator):
    """A simulator of all bodies whose rollouts begin at known states.

    Where the material is known, densities and attributes start from it: attribute 0 is the logarithm of a kernel's
    stiffness over that of the template at zero attributes, attribute 1 that of its damping. They are trained on, since
    the modes of the template are not those of the simulator that moved the body. The template's two damping numbers
    are not trained: errors of phase would make them too large, and the bodies' damping is known.
    """

    model: GausSim

    def __init__(self, model: GausSim, data: CorpusDataModule, scene_of_sequence: Sequence[int]) -> None:
        """Gives the model the bodies' material if it is known and the template decodes one."""
        self.model, self.initial_states = model, None  # type: ignore[assignment]
        self.scene_of_sequence = tuple(scene_of_sequence)
        self._simulator, self._index, self._hands = cast(Simulator, model), data.index, {}
        if data.knows_material and isinstance(model.template, MaterialTemplate):
            for scene_id, item in enumerate(data.objects):
                give_material(model, scene_id, item.body)
            model.template.damping.requires_grad_(False)

    def groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """The model's parameter groups."""
        return self._simulator.parameter_groups()

    def state(self, sequence_id: int, start: int = 0) -> SimState:
        """The true state at frame ``start`` of a sequence."""
        true, like = self._index.state(sequence_id, start), self.model.log_density[0]
        return SimState(true.positions.to(like), true.previous.to(like))


def give_material(model: GausSim, scene_id: int, body: CorpusBody) -> None:
    """Sets densities and attributes of a scene to a body's true material (:func:`_give`)."""
    kernels = model.hierarchies[scene_id].kernels
    density, stiffness, damping = (x.index_select(0, kernels) for x in (body.density, body.stiffness, body.damping))
    _give(
        model, scene_id, density / density.mean(), stiffness / stiffness.mean(), damping, body.record.period / body.fps
    )


def give_even_material(model: GausSim, scene_id: int, *, period: float, damping: float) -> None:
    """Sets densities and attributes of a scene to a material that is the same everywhere.

    Args:
        model: the simulator; its template decodes material.
        scene_id: index of the scene.
        period: period of the slowest mode [s].
        damping: force over momentum; amplitudes fall as exp(-damping t / 2) [1 / s].
    """
    ones = torch.ones_like(model.log_density[scene_id])
    _give(model, scene_id, ones, ones, damping * ones, period)


@torch.no_grad()
def _give(
    model: GausSim,
    scene_id: int,
    density: Float[Tensor, " M"],
    stiffness: Float[Tensor, " M"],
    damping: Float[Tensor, " M"],
    period: float,
) -> None:
    """Sets densities and attributes of the simulated kernels of a scene.

    Attribute 0 is the logarithm of the stiffness over that of the template's reference material. That ratio follows
    from the ``period`` of the slowest mode [s], since the matrices of the template are known; ``stiffness`` and
    ``density`` are relative. Attribute 1 is the logarithm of the damping [1 / s] over the reference's.

    Raises:
        ConfigError: the model's template decodes no material.
    """
    template = model.template
    if not isinstance(template, MaterialTemplate):
        raise ConfigError("model: expected gausim, whose attributes can be set to a known material.")
    attributes = model.attributes[scene_id].zero_()
    model.log_density[scene_id].copy_(density.log())
    attributes[:, 0] = stiffness.log()
    attributes[:, 1] = (damping / (REFERENCE_FPS * math.exp(template.log_drag))).clamp_min(LEAST_DAMPING).log()
    batch = model.batch((scene_id,))
    for _ in range(ROUNDS):
        unit = model.units(batch)[-1][-1]
        made = template.slowest_period(scene_id, unit.log_density, unit.attributes)
        attributes[:, 0] += 2 * math.log(made / period)
