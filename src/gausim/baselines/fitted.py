"""What fitted methods have in common (:class:`gausim.core.FittedMethod`); by itself, the method that never moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypedDict, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.core import FittedState, GaussianScene

T = TypeVar("T")


def moved(value: T, device: torch.device) -> T:
    """A dataclass with its tensors on another device."""
    tensors = {name: x.to(device) for name, x in vars(value).items() if isinstance(x, Tensor)}
    found: T = replace(value, **tensors)  # type: ignore[type-var]
    return found


class Recorded(TypedDict):
    """What a method is fitted to: the options of :class:`Fitted`, which every other method passes on.

    Attributes:
        scenes: the rest scenes.
        fps: frames per second of each.
        scene_of_sequence: the scene of each sequence.
        seen: predicted frames that training may see.
    """

    scenes: Sequence[GaussianScene]
    fps: Sequence[float]
    scene_of_sequence: Sequence[int]
    seen: int


class Fitted(nn.Module):
    """A method with a gradient and a rotation for every kernel, and nothing to learn: a base for others.

    It is made with what it is fitted to (:class:`Recorded`), which it keeps as attributes.

    Attributes:
        name: its row in tables.
        extrapolates: whether frames beyond the seen ones are foreseen.
    """

    name = "static"
    extrapolates = True

    def __init__(
        self, *, scenes: Sequence[GaussianScene], fps: Sequence[float], scene_of_sequence: Sequence[int], seen: int
    ) -> None:
        super().__init__()
        self.scenes, self.fps = tuple(scenes), tuple(fps)
        self.scene_of_sequence, self.seen = tuple(scene_of_sequence), seen

    def notes(self) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def unit_of_kernel(self, scene_id: int) -> Int[Tensor, " K"]:
        """Every kernel is a unit."""
        return torch.arange(self.scenes[scene_id].count)

    def begin(self, sequence_id: int) -> FittedState:
        """The rest state."""
        rest = self.scenes[self.scene_of_sequence[sequence_id]].means.to(self._device)
        identity = torch.eye(3).to(rest).expand(len(rest), 3, 3)
        return FittedState(sequence_id, 0, rest, identity, identity)

    def advance(self, state: FittedState) -> FittedState:
        """The same again."""
        return replace(state, frame=state.frame + 1)

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """None."""
        return {}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """None."""
        return {}

    @property
    def _device(self) -> torch.device:
        return next((p.device for p in self.parameters()), torch.device("cpu"))


class Static(Fitted):
    """The rest state for ever. It scores deceptively well on late frames, so every table needs it beside others."""

    def notes(self) -> tuple[str, ...]:
        """That nothing is learned."""
        return ("Stands still in the rest state; nothing is learned.",)
