"""What a rollout is compared with: videos, motion tracked in them, or the true motion of points."""

from __future__ import annotations

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
from gausim.render.draw import SceneAppearance, draw
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import States
from gausim.training.supervision.comparison import Comparison, ViewGroup, channels

# Losses (T, S) of T predicted frames of S sequences, and the squared change of what is compared, summed. ``start``
# frames were predicted before them. Differentiable in the states through the losses alone.
Compare = Callable[[States, int], tuple[Tensor, Tensor]]


class StaticFigures(NamedTuple):
    """What the rest state scores on each frame of a sequence, and the squared change of the truth to the next one."""

    losses: list[float]
    motion: list[float]


@dataclass(frozen=True, eq=False)
class Sources:
    """What a run has at hand for the making of its supervision.

    Attributes:
        truth: true motion of a sequence by its number, None where it is not known.
        motions: smooth motions that the model can carry, of a scene by its number; None where it has no such basis.
        loss: compares images.
    """

    scenes: Sequence[GaussianScene]
    truth: Callable[[int], GroundTruth | None]
    motions: Callable[[int], SmoothMotions | None]
    renderer: Renderer
    loss: ImageLoss


@runtime_checkable
class Supervision(Protocol):
    """What training compares predictions with."""

    def comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Compare:
        """What compares the rollout of a batch, stretch by stretch."""

    def static(self, sample: SequenceSample, rest: Float[Tensor, "K 3"], first: int) -> StaticFigures:
        """Scores the rest state on frames ``first`` .. T of a sample."""


class Looks:
    """The appearance of every scene's foreground, made once and moved to the device on first use."""

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


class ImageSupervision:
    """Draws predictions in a sample's cameras and compares them with its frames."""

    def __init__(self, scenes: Sequence[GaussianScene], renderer: Renderer, loss: ImageLoss) -> None:
        self.renderer, self.loss = renderer, loss
        self.looks = Looks(scenes)
        self._keys: dict[tuple[int, tuple[str, ...]], Hashable] = {}
        self._rest: dict[Hashable, Rendered] = {}

    def comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Comparison:
        """What draws and compares the predictions of a batch."""
        return self._comparison(samples, batch, slice(1, None))

    def at_rest(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Comparison:
        """What compares one step from the rest state with frame 0 of the samples."""
        return self._comparison(samples, batch, slice(0, 1))

    def _comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch, frames: slice) -> Comparison:
        places: dict[Hashable, list[int]] = {}
        for i, sample in enumerate(samples):
            places.setdefault(self._key(sample), []).append(i)
        groups = [ViewGroup(samples[p[0]].scene_id, tuple(p), samples[p[0]].cameras) for p in places.values()]
        members = zip(samples, batch.members, strict=True)
        looks = [self.looks.of(group.scene_id, batch.rest) for group in groups]
        rest = [self.rest_image(sample, batch.rest[member.kernels]).rgb[0] for sample, member in members]
        true = [sample.frames[frames] for sample in samples]
        return Comparison(self.renderer, self.loss, batch, groups, looks, true, rest)

    def _key(self, sample: SequenceSample) -> Hashable:
        """What must agree for two sequences to be drawn in one call: scene, cameras and image size.

        A sequence's cameras stand still, so they are fetched from the device once.
        """
        cameras, known = sample.cameras, (sample.sequence_id, sample.cameras.names)
        if known not in self._keys:
            numbers = [x.detach().cpu().numpy().tobytes() for x in (cameras.viewmats, cameras.Ks)]
            self._keys[known] = (sample.scene_id, *numbers, cameras.width, cameras.height)
        return self._keys[known]

    def rest_image(self, sample: SequenceSample, rest: Float[Tensor, "K 3"]) -> Rendered:
        """The rest state (one) in a sample's cameras; drawn once per scene and set of cameras."""
        key = self._key(sample)
        if key not in self._rest:
            look = self.looks.of(sample.scene_id, rest)
            identity = torch.eye(3, dtype=rest.dtype, device=rest.device)[None, None]
            units = torch.zeros(rest.shape[0], dtype=torch.long, device=rest.device)
            with torch.no_grad():
                self._rest[key] = draw(self.renderer, look, rest[None], identity, identity, units, sample.cameras)
        return self._rest[key]

    @torch.no_grad()
    def static(self, sample: SequenceSample, rest: Float[Tensor, "K 3"], first: int) -> StaticFigures:
        """Scores the images of the rest state on frames ``first`` .. T of a sample."""
        drawn = self.rest_image(sample, rest)
        frames, alpha = composite(sample.frames[first:].to(drawn.rgb.device))
        image, target = channels(drawn.rgb, drawn.alpha, self.loss), channels(frames, alpha, self.loss)
        losses = self.loss(image.expand_as(target), target).tolist()
        return StaticFigures(losses, (frames[1:] - frames[:-1]).square().sum((1, 2, 3, 4)).tolist())


def training_views(sources: Sources) -> None:
    """Stands for the images of the training views, which every module compares with by itself."""
