"""What is shown: a frame on its way from the simulation to the page, and recordings that can be played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import DivergenceError, SteppedFrame, Trajectory
from gausim.interaction.interaction import Interaction

# The source that can be acted on; the others are recordings.
LIVE = "Live simulation"


@dataclass(frozen=True, eq=False)
class Shown:
    """A frame and what belongs to it.

    Attributes:
        unit_of_kernel: rows of the frame's deformation gradients.
        speed: of the kernels [scene units / s].
        held: kernels pinned by hand; None for none.
        number: its place on the timeline.
        last: the timeline's last place.
        source: :data:`LIVE` or the name of a take.
        beside: the other method's frame, or None.
    """

    frame: SteppedFrame
    unit_of_kernel: Int[Tensor, " K"]
    speed: Float[Tensor, " K"]
    held: Bool[Tensor, " K"] | None = None
    number: int = 0
    last: int = 0
    source: str = LIVE
    beside: Shown | None = None

    @staticmethod
    def of(now: Interaction, beside: Shown | None = None) -> Shown:
        """The latest frame of an interaction."""
        speed = (now.state.positions - now.state.previous).norm(dim=-1) * now.fps
        return Shown(now.frame, now.unit_of_kernel, speed, beside=beside)


@dataclass(frozen=True, eq=False)
class Take:
    """A trajectory that can be played: what a method foresees of a sequence.

    Attributes:
        name: what it is called on the page.
        load: makes it, when it is first asked for.
        sequence: the recorded sequence that it foresees, or None.
        beside: makes what the other method foresees of the same, or None.
    """

    name: str
    load: Callable[[], Trajectory]
    sequence: str | None = None
    beside: Callable[[], Trajectory] | None = None


def shown_frame(trajectory: Trajectory, number: int, name: str, beside: Shown | None = None) -> Shown:
    """A frame of a recording.

    Raises:
        DivergenceError: it is not finite.
    """
    frame = SteppedFrame(
        trajectory.positions[number], trajectory.deformation_gradients[number], trajectory.rotations[number]
    )  # fmt: skip
    if not bool(torch.isfinite(frame.positions).all()):
        raise DivergenceError(f"{name}: frame {number} is not finite.")
    speed = (frame.positions - trajectory.positions[max(0, number - 1)]).norm(dim=-1) * trajectory.fps
    return Shown(frame, trajectory.unit_of_kernel, speed, None, number, trajectory.frames - 1, name, beside)
