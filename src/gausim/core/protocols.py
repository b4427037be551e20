"""Interfaces of methods of dynamics, for whole rollouts and frame by frame, and of renderers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core.state import SimState, Trajectory
from gausim.core.surroundings import HandPose

# Forces at a step: step number (0 = the step from frame 0 to 1) -> force per kernel [mass * scene units / s^2],
# or None where no force acts.
Forces = Callable[[int], Tensor | None]
# Hands at a frame: frame number (-1 is before the initial state) -> their pose, or None where nobody moves the pins.
Hands = Callable[[int], HandPose | None]


@runtime_checkable
class Dynamics(Protocol):
    """A method that predicts the motion of one scene. GausSim and every baseline implement it."""

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames after ``initial``; the result has steps + 1 frames, the initial one first."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One predicted frame of a scene or of a batch."""

    positions: Float[Tensor, "K 3"]  # kernel means [scene units]
    deformation_gradients: Float[Tensor, "N 3 3"]  # accumulated deformation gradients of the N units that carry kernels
    rotations: Float[Tensor, "N 3 3"]  # rotations of these units
    # where the next step starts, if it is more than the last two positions: an impact changed a velocity, for instance
    state: SimState | None = None
    # the momentum loss of the step, summed over the members of a batch; zero where it is switched off
    momentum: Float[Tensor, ""] = field(default_factory=lambda: torch.zeros(()))
    predicted: tuple[Tensor, ...] = ()  # the network's F (N, 3, 3) per predicted level, coarse to fine

    def following(self, state: SimState) -> SimState:
        """The state after this frame, which was predicted from ``state``."""
        return SimState(self.positions, state.positions) if self.state is None else self.state


@runtime_checkable
class Stepper(Protocol):
    """Dynamics computed frame by frame, so that forces can depend on the frames before."""

    @property
    def state(self) -> SimState:
        """The two latest positions of all kernels."""

    @property
    def frame(self) -> Frame:
        """The latest frame; before the first step the initial one."""

    @property
    def unit_of_kernel(self) -> Int[Tensor, " K"]:
        """The unit of each kernel: its row in the frames' deformation gradients and rotations."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def takes_forces(self) -> bool:
        """Whether :meth:`step` may be given a force and held kernels."""

    @property
    def limited(self) -> int:
        """Frames so far whose forces or motion were reduced to stay within the learned range."""

    def step(self, force: Float[Tensor, "K 3"] | None = None, *, held: Bool[Tensor, " K"] | None = None) -> Frame:
        """The next frame.

        Args:
            force: per kernel [mass * scene units / s^2].
            held: kernels that are kept in place during this step, in addition to the pinned ones.

        Raises:
            ConfigError: a force or held kernels are given, but the method does not support them.
            DivergenceError: a position or force is not finite; some methods raise it only some frames later.
        """

    def settle(self) -> None:
        """Raises pending errors: a DivergenceError if any frame so far is not finite."""


@runtime_checkable
class Steppable(Dynamics, Protocol):
    """Dynamics that can be stepped; their rollout takes the same steps, bit for bit."""

    def stepper(self, initial: SimState) -> Stepper:
        """Stepper at a state; its first frame has identity deformation gradients."""


@runtime_checkable
class Handled(Steppable, Protocol):
    """Dynamics whose pins can be moved."""

    takes_hands: bool

    def stepper(self, initial: SimState, hands: Hands | None = None) -> Stepper:
        """Stepper at a state; ``hands`` are the poses of the hands by frame, counted from that state."""


@runtime_checkable
class Adjustable(Steppable, Protocol):
    """Dynamics whose material can be changed; it shows in steppers made afterwards."""

    def adjust(self, stiffness: float, damping: float) -> None:
        """Multiplies the material's stiffness and damping, as they were at the beginning, by factors > 0."""


def roll_out(stepper: Stepper, steps: int, forces: Forces | None = None) -> Trajectory:
    """Takes ``steps`` steps; the result has steps + 1 frames, the stepper's current one first."""
    frames = [stepper.frame]
    for number in range(steps):
        frames.append(stepper.step(forces(number) if forces is not None else None))
    stepper.settle()
    return trajectory_of(frames, stepper)


def trajectory_of(frames: Sequence[Frame], stepper: Stepper) -> Trajectory:
    """Joins frames of a stepper to one trajectory."""
    return Trajectory(
        torch.stack([f.positions for f in frames]),
        torch.stack([f.deformation_gradients for f in frames]),
        torch.stack([f.rotations for f in frames]),
        stepper.unit_of_kernel,
        stepper.fps,
    )


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images of B states seen by V cameras each."""

    rgb: Float[Tensor, "B V H W 3"]  # colour composited over the background, linear in the input colours, not clamped
    alpha: Float[Tensor, "B V H W"]  # accumulated opacity in [0, 1]


@runtime_checkable
class Renderer(Protocol):
    """Renders Gaussians. Differentiable in means, covars, colors, opacities and background."""

    def __call__(
        self,
        means: Float[Tensor, "B K 3"],
        covars: Float[Tensor, "B K 3 3"],
        colors: Float[Tensor, "B V K 3"],
        opacities: Float[Tensor, "B K"],
        viewmats: Float[Tensor, "B V 4 4"],
        Ks: Float[Tensor, "B V 3 3"],
        size: tuple[int, int],
        *,
        background: Float[Tensor, " 3"] | None = None,
    ) -> Rendered:
        """Renders B states (of one scene, or of scenes of equal K) in V views each at ``size`` = (width, height).

        Colours are given per view because they are evaluated for its viewing directions. Without a background it is
        black.
        """
