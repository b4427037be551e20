"""Interface of methods that are fitted to recorded sequences, for training, evaluation and rollouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import Parameter

from gausim.core.errors import ConfigError, DivergenceError
from gausim.core.protocols import Forces, Frame, roll_out
from gausim.core.scene import GaussianScene
from gausim.core.state import SimState, Trajectory


@dataclass(frozen=True, eq=False)
class FittedState:
    """State of a fitted method in one frame of one sequence."""

    sequence_id: int  # the sequence, numbered over all objects
    frame: int  # index of the frame, from 0
    positions: Float[Tensor, "K 3"]  # kernel means [scene units]
    deformation_gradients: Float[Tensor, "N 3 3"]  # deformation gradients of the N units that carry kernels
    rotations: Float[Tensor, "N 3 3"]  # rotations of these units
    # further variables of the method that the next frame needs (anchors, particles, fields)
    inner: tuple[Tensor, ...] = ()

    def detach(self) -> FittedState:
        """The same values, detached from the graph of loss gradients."""
        return replace(
            self,
            positions=self.positions.detach(),
            deformation_gradients=self.deformation_gradients.detach(),
            rotations=self.rotations.detach(),
            inner=tuple(x.detach() for x in self.inner),
        )


@runtime_checkable
class FittedMethod(Protocol):
    """A method with separate parameters for each sequence (an initial velocity) or object (a stiffness).

    It is also a torch module. It uses neither images nor losses: the engine renders its states and compares them with
    the videos, in the stages that ``conf/model/NAME.yaml`` lists.
    """

    name: str  # label of its row in tables
    scenes: Sequence[GaussianScene]  # the rest scenes; their index is the ``scene_id`` of samples
    fps: Sequence[float]  # frames per second of each scene
    scene_of_sequence: Sequence[int]  # the scene of each sequence
    extrapolates: bool  # whether frames beyond the trained ones are predicted; otherwise they repeat the fitted ones

    def notes(self) -> tuple[str, ...]:
        """Remarks on the method, one sentence each, printed under every table."""

    def unit_of_kernel(self, scene_id: int) -> Int[Tensor, " K"]:
        """The unit of every kernel: its row in the states' deformation gradients and rotations."""

    def begin(self, sequence_id: int) -> FittedState:
        """Frame 0 of a sequence; loss gradients reach its parameters."""

    def advance(self, state: FittedState) -> FittedState:
        """The next frame."""

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """All parameters, by the group names to which stages assign learning rates."""

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """Further loss terms of a sequence that a stage may weight (smoothness of fields), by name."""


@runtime_checkable
class TakesOver(Protocol):
    """A fitted method that can be initialised from another trained method (``init_from=RUN``)."""

    def take_over(self, other: object) -> None:
        """Copies the parameters it needs from a trained method.

        Raises:
            ConfigError: ``other`` has none of these parameters.
        """


@dataclass(frozen=True, eq=False)
class FittedDynamics:
    """A fitted method on one of its sequences, as :class:`gausim.core.Dynamics`."""

    method: FittedMethod
    sequence_id: int  # it has a fitted initial velocity

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; of ``initial`` only the positions are used, as frame 0.

        Raises:
            ConfigError: forces are given.
            DivergenceError: a predicted position is not finite; names the frame.
        """
        if forces is not None:
            raise ConfigError(no_forces(self.method))
        return roll_out(self.stepper(initial), steps)

    def stepper(self, initial: SimState) -> FittedStepper:
        """Stepper at frame 0; of ``initial`` only the positions are used, and nothing of a free body."""
        return FittedStepper(self.method, self.sequence_id, initial)


class FittedStepper:
    """Steps a fitted method frame by frame: a :class:`gausim.core.Stepper` without forces."""

    takes_forces: bool = False
    limited: int = 0

    def __init__(self, method: FittedMethod, sequence_id: int, initial: SimState) -> None:
        """Starts sequence ``sequence_id`` of ``method`` at the positions of ``initial``."""
        self._method, self._scene_id = method, method.scene_of_sequence[sequence_id]
        self._inner = method.begin(sequence_id)
        # A free body begins where it was fitted to be.
        free = method.scenes[self._scene_id].surroundings.free
        positions = self._inner.positions if free else initial.positions.to(self._inner.positions)
        self.state = SimState(positions, positions)
        self.frame = Frame(positions, self._inner.deformation_gradients, self._inner.rotations)
        self.unit_of_kernel: Int[Tensor, " K"] = method.unit_of_kernel(self._scene_id)
        self.fps: float = method.fps[self._scene_id]

    def step(self, force: Tensor | None = None, *, held: Tensor | None = None) -> Frame:
        """The next frame.

        Raises:
            ConfigError: a force or held kernels are given.
            DivergenceError: a predicted position is not finite; names the frame.
        """
        if force is not None or held is not None:
            raise ConfigError(no_forces(self._method))
        self._inner = made = self._method.advance(self._inner)
        if not bool(torch.isfinite(made.positions).all()):
            raise DivergenceError(
                f"{self._method.name}: the prediction of '{self._method.scenes[self._scene_id].name}' is not finite at "
                f"frame {made.frame}. Fit it again with smaller rates (model.plan.stages.STAGE.rates)."
            )
        self.state = SimState(made.positions, self.state.positions)
        self.frame = Frame(made.positions, made.deformation_gradients, made.rotations)
        return self.frame

    def settle(self) -> None:
        """Does nothing: every step raises its errors immediately."""


def no_forces(method: FittedMethod) -> str:
    """Error message of a fitted method that is given forces."""
    return f"{method.name}: takes no forces. Simulate without them, or with a model that does."
