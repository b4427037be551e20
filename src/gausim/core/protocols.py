"""The contracts between rooms: what a method of dynamics offers, also frame by frame, and what a renderer offers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core.state import SimState, Trajectory

# Forces at a step: step number (0 = the step from frame 0 to 1) -> force per kernel [mass * scene units / s^2],
# or None where nothing pushes.
Forces = Callable[[int], Tensor | None]


@runtime_checkable
class Dynamics(Protocol):
    """A method that predicts the motion of one scene. GausSim and every baseline are this."""

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames after ``initial``; the result has steps + 1 frames, the initial one first."""


@dataclass(frozen=True, eq=False)
class SteppedFrame:
    """One frame of a scene, as a :class:`gausim.core.Trajectory` holds many.

    Attributes:
        positions: kernel means [scene units].
        deformation_gradients: accumulated deformation gradients of the N units that carry kernels.
        rotations: their rotations.
    """

    positions: Float[Tensor, "K 3"]
    deformation_gradients: Float[Tensor, "N 3 3"]
    rotations: Float[Tensor, "N 3 3"]


@runtime_checkable
class Stepper(Protocol):
    """Dynamics that go on frame by frame, so that what pushes can depend on what is seen."""

    @property
    def state(self) -> SimState:
        """The two latest positions of all kernels."""

    @property
    def frame(self) -> SteppedFrame:
        """The latest frame; before the first step the initial one."""

    @property
    def unit_of_kernel(self) -> Int[Tensor, " K"]:
        """The unit of each kernel, a row of the frames' gradients and rotations."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def takes_forces(self) -> bool:
        """Whether :meth:`step` may be given a force and held kernels."""

    @property
    def limited(self) -> int:
        """Frames so far whose forces acted in part only, or that were cut short, to keep within what was learned."""

    def step(
        self, force: Float[Tensor, "K 3"] | None = None, *, held: Bool[Tensor, " K"] | None = None
    ) -> SteppedFrame:
        """The next frame.

        Args:
            force: per kernel [mass * scene units / s^2].
            held: kernels that stay where they are during this step, beside those that the scene pins.

        Raises:
            ConfigError: a force or held kernels, which this method does not take.
            DivergenceError: a position or force is not finite; some methods say so only some frames later.
        """

    def settle(self) -> None:
        """Raises what is still unsaid: a DivergenceError if any frame so far is not finite."""


@runtime_checkable
class Steppable(Dynamics, Protocol):
    """Dynamics that can be stepped; their rollout makes the same steps, bit for bit."""

    def stepper(self, initial: SimState) -> Stepper:
        """Begins at a state, whose frame has identity gradients."""


def roll_out(stepper: Stepper, steps: int, forces: Forces | None = None) -> Trajectory:
    """Makes ``steps`` steps; the result has steps + 1 frames, the stepper's present one first."""
    frames = [stepper.frame]
    for number in range(steps):
        frames.append(stepper.step(forces(number) if forces is not None else None))
    stepper.settle()
    return trajectory_of(frames, stepper)


def trajectory_of(frames: Sequence[SteppedFrame], stepper: Stepper) -> Trajectory:
    """Frames of a stepper as one trajectory."""
    return Trajectory(
        torch.stack([f.positions for f in frames]),
        torch.stack([f.deformation_gradients for f in frames]),
        torch.stack([f.rotations for f in frames]),
        stepper.unit_of_kernel,
        stepper.fps,
    )


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images of B states seen by V cameras each.

    Attributes:
        rgb: colour composited over the background, linear in the input colours, not clamped.
        alpha: accumulated opacity in [0, 1].
        depth: accumulated depth sum_i w_i z_i [scene units], where kernel i contributes w_i = alpha_i T_i to the pixel
            and has depth z_i at its centre along the camera's axis (gsplat's mode "D"): not divided by ``alpha``, 0
            where nothing is, without the background. None unless it was asked for.
    """

    rgb: Float[Tensor, "B V H W 3"]
    alpha: Float[Tensor, "B V H W"]
    depth: Float[Tensor, "B V H W"] | None = None


@runtime_checkable
class Renderer(Protocol):
    """Draws Gaussians. Differentiable in means, covars, colors, opacities and background."""

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
        depth: bool = False,
    ) -> Rendered:
        """Draws B states (of one scene, or of scenes of equal K) in V views each at ``size`` = (width, height).

        Colours are per view because they are already evaluated for its directions. No background means black.
        ``depth`` asks for the depth as well.
        """
