"""Methods that are fitted to recorded sequences: what training, evaluation and rollouts ask of each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import Parameter

from gausim.core.errors import ConfigError, DivergenceError
from gausim.core.protocols import Forces, SteppedFrame, roll_out
from gausim.core.scene import GaussianScene
from gausim.core.state import SimState, Trajectory


@dataclass(frozen=True, eq=False)
class FittedState:
    """One sequence at one frame.

    Attributes:
        sequence_id: the sequence, numbered over all objects.
        frame: its frame, 0 the first.
        positions: kernel means [scene units].
        deformation_gradients: deformation gradients of the N units that carry kernels.
        rotations: their rotations.
        inner: what the method carries on to the next frame beside these (anchors, particles, fields).
    """

    sequence_id: int
    frame: int
    positions: Float[Tensor, "K 3"]
    deformation_gradients: Float[Tensor, "N 3 3"]
    rotations: Float[Tensor, "N 3 3"]
    inner: tuple[Tensor, ...] = ()

    def detach(self) -> FittedState:
        """The same numbers without history (gradients stop here)."""
        return replace(
            self,
            positions=self.positions.detach(),
            deformation_gradients=self.deformation_gradients.detach(),
            rotations=self.rotations.detach(),
            inner=tuple(x.detach() for x in self.inner),
        )


@runtime_checkable
class FittedMethod(Protocol):
    """A method with parameters of its own for each sequence (an initial velocity) or object (a stiffness).

    It is a torch module besides. It knows neither images nor losses: the engine draws its states with the renderer and
    compares them with the videos, in the stages that ``conf/model/NAME.yaml`` lists.

    Attributes:
        name: its row in tables.
        scenes: the rest scenes; their index is the ``scene_id`` of samples.
        fps: frames per second of each.
        scene_of_sequence: the scene of each sequence.
        extrapolates: whether frames beyond the trained ones are foreseen; else they repeat what was fitted.
    """

    name: str
    scenes: Sequence[GaussianScene]
    fps: Sequence[float]
    scene_of_sequence: Sequence[int]
    extrapolates: bool

    def notes(self) -> tuple[str, ...]:
        """What a reader of its figures must know: one sentence each, printed under every table."""

    def unit_of_kernel(self, scene_id: int) -> Int[Tensor, " K"]:
        """The unit of every kernel of a scene, a row of the states' gradients and rotations."""

    def begin(self, sequence_id: int) -> FittedState:
        """Frame 0 of a sequence; gradients flow into its parameters."""

    def advance(self, state: FittedState) -> FittedState:
        """The next frame."""

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """All parameters by the name that stages give a learning rate to."""

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """What else a stage may weigh and minimise for a sequence (smoothness of fields), by name."""


@runtime_checkable
class TakesOver(Protocol):
    """A fitted method that begins with what another has found (``init_from=RUN``)."""

    def take_over(self, other: object) -> None:
        """Copies what it needs of a trained method.

        Raises:
            ConfigError: ``other`` has nothing for it.
        """


@dataclass(frozen=True, eq=False)
class FittedDynamics:
    """A fitted method on one of its sequences, as :class:`gausim.core.Dynamics`."""

    method: FittedMethod
    sequence_id: int  # it brings its own initial velocity

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; only the positions of ``initial`` count, as frame 0.

        Raises:
            ConfigError: forces are given.
            DivergenceError: the prediction left the finite numbers; names the frame.
        """
        if forces is not None:
            raise ConfigError(no_forces(self.method))
        return roll_out(self.stepper(initial), steps)

    def stepper(self, initial: SimState) -> FittedStepper:
        """Begins at frame 0; only the positions of ``initial`` count."""
        return FittedStepper(self.method, self.sequence_id, initial)


class FittedStepper:
    """A fitted method frame by frame: :class:`gausim.core.Stepper` that takes no forces."""

    takes_forces: bool = False
    limited: int = 0

    def __init__(self, method: FittedMethod, sequence_id: int, initial: SimState) -> None:
        """Begins ``method``'s sequence ``sequence_id`` at the positions of ``initial``."""
        self._method, self._scene_id = method, method.scene_of_sequence[sequence_id]
        self._inner = method.begin(sequence_id)
        positions = initial.positions.to(self._inner.positions)
        self.state = SimState(positions, positions)
        self.frame = SteppedFrame(positions, self._inner.deformation_gradients, self._inner.rotations)
        self.unit_of_kernel: Int[Tensor, " K"] = method.unit_of_kernel(self._scene_id)
        self.fps: float = method.fps[self._scene_id]

    def step(self, force: Tensor | None = None, *, held: Tensor | None = None) -> SteppedFrame:
        """The next frame.

        Raises:
            ConfigError: a force or held kernels are given.
            DivergenceError: the prediction left the finite numbers; names the frame.
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
        self.frame = SteppedFrame(made.positions, made.deformation_gradients, made.rotations)
        return self.frame

    def settle(self) -> None:
        """Nothing: every step says at once what is wrong."""


def no_forces(method: FittedMethod) -> str:
    """Why a fitted method cannot be pushed, in words."""
    return f"{method.name}: takes no forces. Simulate without them, or with a model that does."
