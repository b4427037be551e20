"""Base of the methods that are fitted per sequence (:class:`gausim.core.FittedMethod`), and the static method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypedDict, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.core import ConfigError, FittedState, GaussianScene

T = TypeVar("T")


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
    """Base of fitted methods: a deformation gradient and a rotation per kernel, no parameters, no motion.

    The options (:class:`Recorded`) become attributes.

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
        """No notes."""
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
        """The same state in the next frame."""
        return replace(state, frame=state.frame + 1)

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """No parameters."""
        return {}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """No penalties."""
        return {}

    @property
    def _device(self) -> torch.device:
        return next((p.device for p in self.parameters()), torch.device("cpu"))


class Static(Fitted):
    """The rest state in every frame: every table needs this row, whose errors in late frames are deceptively small."""

    def notes(self) -> tuple[str, ...]:
        """The note that nothing is learned."""
        return ("Stands still in the rest state; nothing is learned.",)
