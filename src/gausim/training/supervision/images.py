"""Supervision of rollouts: the interface, and supervision by the images of the training views."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import GaussianScene, Rendered, Renderer, SmoothMotions
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.data.records import GroundTruth
from gausim.losses.image import ImageLoss
from gausim.models.hierarchy.units import UnitMotion
from gausim.models.reference.reference import Carried
from gausim.render.draw import SceneAppearance, draw
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import States
from gausim.training.supervision.comparison import Comparison, ViewGroup, channels

# Losses (T, S) of T predicted frames of S sequences, and the summed squared change of the compared quantity. ``start``
# is the number of frames predicted before them. Only the losses are differentiable in the states.
Compare = Callable[[States, int], tuple[Tensor, Tensor]]


class StaticFigures(NamedTuple):
    """Loss of the rest state on each frame of a sequence, and squared change of the truth to the next frame."""

    losses: list[float]
    motion: list[float]


@dataclass(frozen=True, eq=False)
class Sources:
    """Parts of a run from which supervision is built."""

    scenes: Sequence[GaussianScene]
    truth: Callable[[int], GroundTruth | None]  # true motion of a sequence by its number, None where it is unknown
    motions: Callable[[int], SmoothMotions]  # smooth motions of the model's template, of a scene by its number
    renderer: Renderer
    loss: ImageLoss  # image loss
    # references of a sequence, by its number, in the steps to frames 1..T; None where they are the rest state
    references: Callable[[int, int], Sequence[tuple[Carried, UnitMotion]] | None] = lambda sequence_id, steps: None


@runtime_checkable
class Supervision(Protocol):
    """Interface of supervision: losses of predictions and of the rest state."""

    def comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Compare:
        """Loss function of a batch's rollout, called for each stretch."""

    def static(self, sample: SequenceSample, rest: Float[Tensor, "K 3"], first: int) -> StaticFigures:
        """Losses of the rest state on frames ``first`` .. T of a sample."""


class Appearances:
    """Appearance of every scene's foreground, computed once and moved to the device on first use."""

    def __init__(self, scenes: Sequence[GaussianScene]) -> None:
        self._scenes = list(scenes)
        self._made: dict[int, SceneAppearance] = {}

    def of(self, scene_id: int, like: Tensor) -> SceneAppearance:
        """The appearance of a scene, on the device and in the type of ``like``."""
        if scene_id not in self._made:
            scene = self._scenes[scene_id]
            self._made[scene_id] = SceneAppearance.of(scene, scene.foreground)
        self._made[scene_id] = self._made[scene_id].to(like)
        return self._made[scene_id]


class ViewKeys:
    """Keys of sequences that one call of the renderer can draw together: scene, cameras and image size.

    The cameras of a sequence are constant, so they are fetched from the device once.
    """

    def __init__(self) -> None:
        self._keys: dict[tuple[int, tuple[str, ...]], Hashable] = {}

    def of(self, sample: SequenceSample) -> Hashable:
        """The key of a sample's sequence."""
        cameras, known = sample.cameras, (sample.sequence_id, sample.cameras.names)
        if known not in self._keys:
            numbers = [x.detach().cpu().numpy().tobytes() for x in (cameras.viewmats, cameras.Ks)]
            self._keys[known] = (sample.scene_id, *numbers, cameras.width, cameras.height)
        return self._keys[known]


class ImageSupervision:
    """Supervision by images: renders predictions in a sample's cameras and compares them with its frames."""

    def __init__(self, scenes: Sequence[GaussianScene], renderer: Renderer, loss: ImageLoss) -> None:
        self.renderer, self.loss = renderer, loss
        self.appearances = Appearances(scenes)
        self._keys = ViewKeys()
        self._rest: dict[Hashable, Rendered] = {}
        # Positions at frame 0 of sequences whose bodies do not begin at rest: those with which training began, which
        # do not depend on when it was resumed, else the present ones; set by the start of training and the learner.
        self.begun: dict[int, Float[Tensor, "K 3"]] = {}
        self.begins: Callable[[SequenceSample], Float[Tensor, "K 3"] | None] = lambda sample: None

    def comparison(
        self, samples: Sequence[SequenceSample], batch: SceneBatch, frames: slice = slice(1, None)
    ) -> Comparison:
        """Rendering and image loss of the predictions of a batch, against some ``frames`` of the samples."""
        places: dict[Hashable, list[int]] = {}
        for i, sample in enumerate(samples):
            places.setdefault(self._keys.of(sample), []).append(i)
        groups = [ViewGroup(samples[p[0]].scene_id, tuple(p), samples[p[0]].cameras) for p in places.values()]
        members = zip(samples, batch.members, strict=True)
        appearances = [self.appearances.of(group.scene_id, batch.rest) for group in groups]
        rest = [self.rest_image(sample, batch.rest[member.kernels]).rgb[0] for sample, member in members]
        true = [sample.frames[frames] for sample in samples]
        return Comparison(self.renderer, self.loss, batch, groups, appearances, true, rest)

    def rest_image(self, sample: SequenceSample, rest: Float[Tensor, "K 3"]) -> Rendered:
        """Image of the rest state in a sample's cameras; rendered once per scene and set of cameras.

        Of a body that begins elsewhere it is an image of where it begins, rendered once per sequence.
        """
        key, first = self._keys.of(sample), self.begun.get(sample.sequence_id)
        first = self.begins(sample) if first is None else first.to(rest)
        if first is not None:
            key, rest = (key, sample.sequence_id), first
        if key not in self._rest:
            self._rest[key] = self.undeformed(sample, rest)
        return self._rest[key]

    @torch.no_grad()
    def undeformed(self, sample: SequenceSample, positions: Float[Tensor, "K 3"]) -> Rendered:
        """Image of a sample's scene in its cameras, with undeformed kernels at some positions."""
        appearance = self.appearances.of(sample.scene_id, positions)
        identity = torch.eye(3, dtype=positions.dtype, device=positions.device)[None, None]
        units = torch.zeros(len(positions), dtype=torch.long, device=positions.device)
        return draw(self.renderer, appearance, positions[None], identity, identity, units, sample.cameras)

    @torch.no_grad()
    def static(self, sample: SequenceSample, rest: Float[Tensor, "K 3"], first: int) -> StaticFigures:
        """Image losses of the rest state on frames ``first`` .. T of a sample."""
        drawn = self.rest_image(sample, rest)
        frames, alpha = composite(sample.frames[first:].to(drawn.rgb.device))
        image, target = channels(drawn.rgb, drawn.alpha, self.loss), channels(frames, alpha, self.loss)
        losses = self.loss(image.expand_as(target), target).tolist()
        return StaticFigures(losses, (frames[1:] - frames[:-1]).square().sum((1, 2, 3, 4)).tolist())


def training_views(sources: Sources) -> None:
    """Selects the images of the training views, the learner's default supervision."""
