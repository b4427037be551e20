"""One scene of the simulator, frame by frame, without gradients: :class:`gausim.core.Stepper`."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import SimState, SteppedFrame
from gausim.models.rollout.cuda_graph import GraphedStep, StepFunction
from gausim.models.rollout.energy_guard import EnergyGuard
from gausim.models.rollout.watch import Watch
from gausim.models.step.prepared import Prepared
from gausim.models.step.simulator import GausSim
from gausim.nn.mode import evaluating


class SceneStepper:
    """Steps of one scene from one initial state, the network's correction held back where it would add energy.

    Attributes:
        state: the two latest positions of all kernels [scene units].
        frame: the latest frame.
        unit_of_kernel: the unit of each kernel.
        fps: frames per second.
        takes_forces: True.
    """

    takes_forces: bool = True

    @torch.no_grad()
    def __init__(
        self, model: GausSim, scene_id: int, initial: SimState, *, energy_ceiling: float | None = None
    ) -> None:
        """Begins at ``initial``, a state of the model's scene number ``scene_id``.

        Args:
            model: with whatever limit on energy it has.
            scene_id: of the scene.
            initial: where it begins.
            energy_ceiling: the highest energy that forces can reach, for models that know one; None: any.
        """
        self._ceiling = energy_ceiling
        batch = model.batch((scene_id,))
        member = batch.members[0]
        identity = torch.eye(3).to(initial.positions).expand(member.units.stop - member.units.start, 3, 3)
        self._model = model
        self.fps: float = model.fps[scene_id]
        self.state, self.frame = initial, SteppedFrame(initial.positions, identity, identity)
        self.unit_of_kernel: Int[Tensor, " K"] = member.unit_of_kernel
        self._number = 0
        self._watch = Watch(model.scenes[scene_id].name, initial.positions.device)
        self._watch.positions(0, initial.positions, initial.previous)
        prepared = model.prepare(batch)
        self._step, self._guard = self._function(prepared), self._made_guard(prepared)

    @property
    def limited(self) -> int:
        """Frames so far that the energy's ceiling limited."""
        return 0 if self._guard is None else self._guard.limited

    @torch.no_grad()
    def step(
        self, force: Float[Tensor, "K 3"] | None = None, *, held: Bool[Tensor, " K"] | None = None
    ) -> SteppedFrame:
        """The next frame; a kernel that is held stays where it is, the shape of its unit does not.

        Raises:
            DivergenceError: an earlier position, or the force, is not finite (on the CPU at once, on other devices up
                to :data:`gausim.models.rollout.watch.INTERVAL` frames later); the message names the frame.
        """
        if force is not None:
            self._watch.forces(self._number, force)
        self._watch.ask(self._number)
        with evaluating(self._model):
            guard = self._guard
            made = self._step(self.state, force) if guard is None else guard.step(self._step, self.state, force)
        positions = made.positions
        if held is not None:
            positions = torch.where(held[:, None], self.state.positions, positions)
        self._number += 1
        self._watch.positions(self._number, positions)
        self.state = SimState(positions, self.state.positions)
        self.frame = SteppedFrame(positions, made.deformation_gradients, made.rotations)
        return self.frame

    def settle(self) -> None:
        """Raises a DivergenceError if any frame so far is not finite."""
        self._watch.ask(self._number, now=True)

    def _function(self, prepared: Prepared) -> StepFunction:
        def step(state: SimState, force: Tensor | None) -> SteppedFrame:
            return self._model.step(prepared.batch, state, force, prepared)

        rest = prepared.batch.rest
        if self._model.rollout.cuda_graph and rest.device.type == "cuda":
            return GraphedStep(step, rest)
        return step

    def _made_guard(self, prepared: Prepared) -> EnergyGuard | None:
        frames = self._model.rollout.energy_guard_frames
        if not (frames and self._model.knows_energy):
            return None
        return EnergyGuard(self._model, prepared, frames, ceiling=self._ceiling)
