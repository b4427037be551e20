"""Frames for display, and recordings that can be played."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import DivergenceError, Frame, Trajectory
from gausim.interaction.interaction import Interaction

# Name of the interactive source; the others are recordings.
LIVE = "Live simulation"


@dataclass(frozen=True, eq=False)
class Shown:
    """A frame with the data for its display."""

    frame: Frame
    unit_of_kernel: Int[Tensor, " K"]  # the unit of each kernel, a row of the frame's deformation gradients
    speed: Float[Tensor, " K"]  # speeds of the kernels [scene units / s]
    held: Bool[Tensor, " K"] | None = None  # mask of the kernels pinned by events; None without any
    number: int = 0  # index of the frame on the timeline
    last: int = 0  # last index of the timeline
    source: str = LIVE  # :data:`LIVE` or the name of a take

    @staticmethod
    def of(now: Interaction) -> "Shown":
        """The latest frame of an interaction."""
        speed = (now.state.positions - now.state.previous).norm(dim=-1) * now.fps
        return Shown(now.frame, now.unit_of_kernel, speed)


@dataclass(frozen=True, eq=False)
class Take:
    """A trajectory that can be played: a method's prediction of a sequence."""

    name: str  # name on the page
    load: Callable[[], Trajectory]  # computes the trajectory, called at its first use


def shown_frame(trajectory: Trajectory, number: int, name: str) -> Shown:
    """A frame of a recording for display.

    Raises:
        DivergenceError: a position of the frame is not finite.
    """
    frame = Frame(
        trajectory.positions[number], trajectory.deformation_gradients[number], trajectory.rotations[number]
    )  # fmt: skip
    if not bool(torch.isfinite(frame.positions).all()):
        raise DivergenceError(f"{name}: frame {number} is not finite.")
    speed = (frame.positions - trajectory.positions[max(0, number - 1)]).norm(dim=-1) * trajectory.fps
    return Shown(frame, trajectory.unit_of_kernel, speed, None, number, trajectory.frames - 1, name)
