"""Base of the methods that are fitted per sequence, the static method, and their dynamics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.core import ConfigError, DivergenceError, Forces, Frame, GaussianScene, SimState, Trajectory, roll_out

T = TypeVar("T")


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

    def detach(self) -> "FittedState":
        """The same values, detached from the graph of loss gradients."""
        return replace(
            self,
            positions=self.positions.detach(),
            deformation_gradients=self.deformation_gradients.detach(),
            rotations=self.rotations.detach(),
            inner=tuple(x.detach() for x in self.inner),
        )


def moved(value: T, device: torch.device) -> T:
    """A dataclass with its tensors on another device."""
    tensors = {name: x.to(device) for name, x in vars(value).items() if isinstance(x, Tensor)}
    found: T = replace(value, **tensors)  # type: ignore[type-var]
    return found


def surroundings_of(scene: GaussianScene) -> dict[str, str]:
    """Surroundings of a scene with their text for messages: free, gravity, trained_gravity, floor, hands."""
    around = scene.surroundings
    present = {
        "free": (around.free, "'free'"),
        "gravity": (around.gravity is not None, "'gravity'"),
        "trained_gravity": (around.trains_gravity, "'gravity' that is trained"),
        "floor": (around.floor is not None, "a 'floor'"),
        "hands": (scene.hand is not None, "a 'grip' of hands"),
    }
    return {key: text for key, (there, text) in present.items() if there}


class Recorded(TypedDict):
    """Inputs of every fitted method: the options of :class:`Fitted`, which its subclasses pass on."""

    scenes: Sequence[GaussianScene]  # the rest scenes
    fps: Sequence[float]  # frames per second of each
    scene_of_sequence: Sequence[int]  # the scene of each sequence
    seen: int  # predicted frames that training may see


class Fitted(nn.Module):
    """A method with parameters of each sequence (an initial velocity) or object (a stiffness); this one has none.

    It uses neither images nor losses: its states are rendered and compared with the videos, in the stages that
    ``conf/model/NAME.yaml`` lists. The options (:class:`Recorded`) become attributes.

    Attributes:
        name: name of the method in tables.
        extrapolates: whether the method predicts frames beyond the seen ones.
        unknown: surroundings that the method cannot predict, of :func:`surroundings_of`.
    """

    name = "static"
    extrapolates = True
    unknown: frozenset[str] = frozenset()

    def __init__(
        self, *, scenes: Sequence[GaussianScene], fps: Sequence[float], scene_of_sequence: Sequence[int], seen: int
    ) -> None:
        super().__init__()
        for scene in scenes:
            if found := [text for key, text in surroundings_of(scene).items() if key in self.unknown]:
                raise ConfigError(
                    f"{self.name}: '{scene.name}' has {', '.join(found)} in its dataset.json, of which this method "
                    "knows nothing. Take model=gausim, or objects without them (data.names)."
                )
        self.scenes, self.fps = tuple(scenes), tuple(fps)
        self.scene_of_sequence, self.seen = tuple(scene_of_sequence), seen

    def notes(self) -> tuple[str, ...]:
        """Remarks on the method, one sentence each, printed under every table."""
        return ()

    def unit_of_kernel(self, scene_id: int) -> Int[Tensor, " K"]:
        """The unit of every kernel, its row in the states' deformation gradients and rotations: a unit per kernel."""
        return torch.arange(self.scenes[scene_id].count)

    def begin(self, sequence_id: int) -> FittedState:
        """Frame 0 of a sequence, the rest state; loss gradients reach its parameters."""
        rest = self.scenes[self.scene_of_sequence[sequence_id]].means.to(self._device)
        identity = torch.eye(3).to(rest).expand(len(rest), 3, 3)
        return FittedState(sequence_id, 0, rest, identity, identity)

    def advance(self, state: FittedState) -> FittedState:
        """The next frame, here the same state."""
        return replace(state, frame=state.frame + 1)

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """All parameters, by the group names to which stages assign learning rates."""
        return {}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """Further loss terms of a sequence that a stage may weight (smoothness of fields), by name."""
        return {}

    @property
    def _device(self) -> torch.device:
        return next((p.device for p in self.parameters()), torch.device("cpu"))


class Static(Fitted):
    """The rest state in every frame: every table needs this row, whose errors in late frames are deceptively small."""

    def notes(self) -> tuple[str, ...]:
        """The note that nothing is learned."""
        return ("Stays in the rest state; nothing is learned.",)


@dataclass(frozen=True, eq=False)
class FittedDynamics:
    """A fitted method on one of its sequences, as :class:`gausim.core.Dynamics`."""

    method: Fitted
    sequence_id: int  # it has a fitted initial velocity

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; of ``initial`` only the positions are used, as frame 0.

        Raises:
            ConfigError: forces are given.
            DivergenceError: a predicted position is not finite; names the frame.
        """
        if forces is not None:
            raise _no_forces(self.method)
        return roll_out(self.stepper(initial), steps)

    def stepper(self, initial: SimState) -> "FittedStepper":
        """Stepper at frame 0; of ``initial`` only the positions are used, and nothing of a free body."""
        return FittedStepper(self.method, self.sequence_id, initial)


class FittedStepper:
    """Steps a fitted method frame by frame: a :class:`gausim.core.Stepper` without forces."""

    takes_forces: bool = False
    limited: int = 0

    def __init__(self, method: Fitted, sequence_id: int, initial: SimState) -> None:
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
            raise _no_forces(self._method)
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


def _no_forces(method: Fitted) -> ConfigError:
    return ConfigError(f"{method.name}: takes no forces. Simulate without them, or with a model that does.")
