"""Rollouts of one scene by the simulator, without loss gradients: :class:`gausim.core.Steppable`."""

import copy
import math
from dataclasses import replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import DivergenceError, Forces, Frame, Hands, SimState, Trajectory, roll_out
from gausim.models.reference.reference import hand_motion
from gausim.models.rollout.amplitude_guard import AmplitudeGuard
from gausim.models.rollout.cuda_graph import GraphedStep
from gausim.models.rollout.energy_guard import EnergyGuard
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.nn.mode import evaluating

INTERVAL = 64  # frames between two checks for finite values on a CUDA device; each check synchronises the host


class SceneDynamics:
    """Rollouts of one scene of a :class:`GausSim`, without loss gradients and in evaluation mode."""

    takes_hands: bool = True

    def __init__(
        self, model: GausSim, scene_id: int = 0, *, energy_ceiling: float | None = None, correction_scale: float = 1.0
    ) -> None:
        """Binds ``model`` to its scene ``scene_id``; the other arguments are those of :class:`SceneStepper`."""
        self.model, self.scene_id, self.energy_ceiling = model, scene_id, energy_ceiling
        self.correction_scale = correction_scale

    @property
    @torch.no_grad()
    def masses(self) -> Float[Tensor, " K"]:
        """Mass of every kernel of the scene, up to a common factor; 0 for those never simulated."""
        scene, hierarchy = self.model.scenes[self.scene_id], self.model.hierarchies[self.scene_id]
        own, _ = self.model.masses(self.model.batch((self.scene_id,)))
        return own.new_zeros(scene.count).index_copy(0, hierarchy.kernels.to(own.device), own)

    def rollout(
        self, initial: SimState, steps: int, *, forces: Forces | None = None, hands: Hands | None = None
    ) -> Trajectory:
        """Predicts ``steps`` frames; frame 0 is the initial state, undeformed (METHOD: the rest state).

        Raises:
            DivergenceError: a position or force is not finite; the message names the frame.
        """
        with evaluating(self.model):
            return roll_out(self.stepper(initial, hands), steps, forces)

    def stepper(self, initial: SimState, hands: Hands | None = None) -> "SceneStepper":
        """Stepper from an initial state; its steps are those of :meth:`rollout`."""
        return SceneStepper(
            self.model, self.scene_id, initial, energy_ceiling=self.energy_ceiling, hands=hands,
            correction_scale=self.correction_scale,
        )  # fmt: skip


class MaterialDynamics(SceneDynamics):
    """Rollouts of a scene whose attributes 0 and 1 are the logarithms of its stiffness and damping.

    It has parameters and a template of its own, so that :meth:`adjust` leaves the given model as it is.
    """

    def __init__(self, model: GausSim, scene_id: int = 0, *, energy_ceiling: float | None = None) -> None:
        shared = {id(part): part for part in (*model.scenes, *model.hierarchies)}  # large, and never changed
        model = copy.deepcopy(model, shared)
        super().__init__(model, scene_id, energy_ceiling=energy_ceiling)
        self._given = model.attributes[scene_id].detach().clone()
        self._ceiling = energy_ceiling

    def adjust(self, stiffness: float, damping: float) -> None:
        """Multiplies stiffness and damping, as they were at the beginning, by factors > 0; see :class:`Adjustable`.

        Where a body has no drag, viscosity is what is multiplied.
        """
        changed, template = self._given.clone(), cast(MaterialTemplate, self.model.template)
        changed[:, 0] += math.log(stiffness)
        if template.has_drag(self.scene_id):
            changed[:, 1] += math.log(damping)
        else:
            template.viscosity_scale[self.scene_id] = damping
        self.model.attributes[self.scene_id].data.copy_(changed)
        self.energy_ceiling = None if self._ceiling is None else stiffness * self._ceiling  # the same motion


def scene_dynamics(model: GausSim, scene_id: int = 0, *, energy_ceiling: float | None = None) -> SceneDynamics:
    """The dynamics of a scene; where the model's template decodes a material, it can be adjusted."""
    kind = MaterialDynamics if isinstance(model.template, MaterialTemplate) else SceneDynamics
    return kind(model, scene_id, energy_ceiling=energy_ceiling)


class SceneStepper:
    """Steps of one scene from one initial state, with the energy guard if configured (:class:`gausim.core.Stepper`)."""

    takes_forces: bool = True

    @torch.no_grad()
    def __init__(
        self,
        model: GausSim,
        scene_id: int,
        initial: SimState,
        *,
        energy_ceiling: float | None = None,
        hands: Hands | None = None,
        correction_scale: float = 1.0,
    ) -> None:
        """Begins at ``initial``, a state of the model's scene ``scene_id``.

        Args:
            model: the simulator.
            scene_id: index of the scene.
            initial: positions at frames 0 and -1.
            energy_ceiling: the highest energy that forces may reach, for models with an energy; None: no limit.
            hands: poses of the hands that move the pins, by frame.
            correction_scale: factor on the network's output; 0: the template alone.
        """
        batch = model.batch((scene_id,))
        member, prepared = batch.members[0], model.prepare(batch, driven=hands is not None)
        moves = prepared.reference.moves
        self._model, self._name = model, model.scenes[scene_id].name
        self.fps: float = model.fps[scene_id]
        self._hands, self._number = hands, 0
        self.state, self.frame = initial, Frame(initial.positions, *prepared.reference.undeformed(initial))
        self.unit_of_kernel: Int[Tensor, " K"] = member.unit_of_kernel

        def step(state: SimState, force: Tensor | None) -> Frame:
            hands = [hand_motion(self._hands, self._number)]
            return model.step(batch, state, force, prepared, correction_scale, hands)

        graphed = model.rollout.cuda_graph and batch.rest.device.type == "cuda" and not moves and not model.history
        self._step = GraphedStep(step, batch.rest) if graphed else step
        self._guard: EnergyGuard | AmplitudeGuard | None = None
        # Gravity, impacts and hands change the energy of a body that is not in fixed pins.
        if model.rollout.energy_guard_frames and not moves:
            if model.knows_energy:
                self._guard = EnergyGuard(model, prepared, self._step, ceiling=energy_ceiling)
            elif (oscillator := model.template.oscillator(scene_id))[0] > 0:
                self._guard = AmplitudeGuard(model, prepared, self._step, oscillator)
        # Whether positions and forces were finite since the last check; kept on the device, read every `_interval`.
        self._finite = torch.ones(2, dtype=torch.bool, device=initial.positions.device)
        self._asked = 0
        self._interval = 1 if initial.positions.device.type == "cpu" else INTERVAL
        self._note(0, torch.cat((initial.positions, initial.previous)))

    @property
    def limited(self) -> int:
        """Number of frames so far that the energy ceiling limited."""
        return 0 if self._guard is None else self._guard.limited

    @torch.no_grad()
    def step(self, force: Float[Tensor, "K 3"] | None = None, *, held: Bool[Tensor, " K"] | None = None) -> Frame:
        """The next frame; kernels in ``held`` keep their position, while their unit deforms as predicted.

        Raises:
            DivergenceError: an earlier position, or the force, is not finite (on the CPU at once, on other devices up
                to :data:`INTERVAL` frames later); the message names the frame.
        """
        if force is not None:
            self._note(1, force)
        self._ask(now=False)
        with evaluating(self._model):
            frame = (self._step if self._guard is None else self._guard.step)(self.state, force)
        positions = frame.positions
        if held is not None:
            positions = torch.where(held[:, None], self.state.positions, positions)
        self._number += 1
        self._note(0, positions)
        self.state = replace(frame.following(self.state), positions=positions)
        self.frame = Frame(positions, frame.deformation_gradients, frame.rotations)
        return self.frame

    def settle(self) -> None:
        """Raises a DivergenceError if any frame so far is not finite."""
        self._ask(now=True)

    def _note(self, kind: int, values: Tensor) -> None:
        self._finite[kind].logical_and_(torch.isfinite(values).all().to(self._finite.device))

    def _ask(self, *, now: bool) -> None:
        if not now and self._number % self._interval:
            return
        first, last = min(self._asked, self._number), self._number
        for kind, finite in zip(("positions", "forces"), self._finite.tolist(), strict=True):
            if not finite:
                where = f"frame {last}" if first == last else f"one of the frames {first} to {last}"
                raise DivergenceError(
                    f"{self._name}: {kind} are not finite at {where}. "
                    "Reset the state, or use a smaller force or a model trained longer."
                )
        self._asked = last + 1
