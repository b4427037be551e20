"""Training on bodies whose motion, and where given whose material, is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch

from gausim.core import ConfigError, SimState, Trajectory
from gausim.data.corpus import CorpusBody
from gausim.data.dataset import SequenceSample
from gausim.data.pretraining import CorpusDataModule
from gausim.models.hierarchy.units import fixed_units
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import REFERENCE_FPS, MaterialTemplate
from gausim.training.contracts import Simulator
from gausim.training.method import SharedSimulator


class KnownStates(SharedSimulator):
    """A simulator of all bodies whose rollouts begin at known states.

    Where the material is known, densities and attributes start from it: attribute 0 is the logarithm of a kernel's
    stiffness over that of the template at zero attributes, attribute 1 that of its damping. They are trained on, since
    the modes of the template are not those of the simulator that moved the body.
    """

    def __init__(self, model: GausSim, data: CorpusDataModule, scene_of_sequence: Sequence[int]) -> None:
        """Gives the model the bodies' material if it is known."""
        self.model, self.initial_states = model, None  # type: ignore[assignment]
        self.scene_of_sequence, self._simulator, self._index = (
            tuple(scene_of_sequence),
            cast(Simulator, model),
            data.index,
        )
        self._gausim, self._hands = model, {}
        if data.knows_material:
            for scene_id, item in enumerate(data.objects):
                give_material(model, scene_id, item.body)

    def groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """The model's parameter groups."""
        return self._simulator.parameter_groups()

    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """The true states at the beginnings of the samples."""
        states = [self._index.state(s.sequence_id, s.start) for s in samples]
        now, before = (torch.cat([getattr(s, name) for s in states]) for name in ("positions", "previous"))
        return SimState(now.to(batch.rest), before.to(batch.rest))

    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a sequence from its true state at frame 0."""
        scene_id, like = self.scene_of_sequence[sequence_id], self._gausim.log_density[0]
        state = self._index.state(sequence_id, 0)
        initial = SimState(state.positions.to(like), state.previous.to(like))
        return SceneDynamics(self._gausim, scene_id).rollout(initial, steps)


@torch.no_grad()
def give_material(model: GausSim, scene_id: int, body: CorpusBody) -> None:
    """Sets densities and attributes of a scene from a body's true material.

    Attribute 0 of kernel k is ln(E_k / E_0), where the template at zero attributes has a homogeneous stiffness E_0. E_0
    is not known in the units of the corpus; it follows from the lowest period of the body, which is that of the
    template's matrices with these factors. Attribute 1 is ln(c_k / c_0) of the damping c [1 / s].

    Raises:
        ConfigError: the model's template decodes no material.
    """
    template = model.template
    if not isinstance(template, MaterialTemplate) or model.attributes[scene_id].shape[1] < 2:
        raise ConfigError(
            "model: pretraining needs a template that decodes material from two or more attributes (gausim)."
        )
    kernels, attributes = model.hierarchies[scene_id].kernels, model.attributes[scene_id]
    density, stiffness, damping = (x.index_select(0, kernels) for x in (body.density, body.stiffness, body.damping))
    model.log_density[scene_id].copy_((density / density.mean()).log())
    attributes[:, 0] = (stiffness / stiffness.mean()).log()
    attributes[:, 1] = (damping / (REFERENCE_FPS * math.exp(template.start[1]))).clamp_min(1e-3).log()
    attributes[:, 0] += math.log(_stiffness_for(model, template, scene_id, body.record.period / body.fps))


def _stiffness_for(model: GausSim, template: MaterialTemplate, scene_id: int, period: float) -> float:
    """Factor on the stiffness by which the lowest mode has the ``period`` [s]."""
    batch = model.batch((scene_id,))
    _, levels = fixed_units(batch, model.masses(batch)[0], model.attributes[scene_id])
    unit, body = levels[-1], template.body(scene_id)
    stiffness = torch.einsum("n,pnlm->lm", unit.attributes[:, 0].exp(), body.stiffness)
    inertia = torch.einsum("nal,n,nam->lm", body.inertia, unit.log_density.exp(), body.inertia)
    root = torch.linalg.inv(torch.linalg.cholesky(inertia))
    lowest = float(torch.linalg.eigvalsh(root @ stiffness @ root.mT)[0])
    reference = 2 * math.pi / math.exp(template.start[0] / 2) / REFERENCE_FPS
    return (reference / period) ** 2 / lowest
