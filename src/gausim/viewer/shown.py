"""A frame on its way from the simulation to the page."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import SteppedFrame

# The source that can be acted on; the others are recordings.
LIVE = "Live simulation"


@dataclass(frozen=True, eq=False)
class Shown:
    """A frame and what belongs to it.

    Attributes:
        frame: positions, gradients and rotations.
        unit_of_kernel: rows of the gradients.
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
