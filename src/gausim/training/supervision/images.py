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
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import Looks, States, Views, draw_rest
from gausim.training.supervision.comparison import Comparison, channels

# Losses (T, S) of T predicted frames of S sequences, and the squared change of what is compared, summed. ``start``
# frames were predicted before them. Differentiable in the states through the losses alone.
Compare = Callable[[States, int], tuple[Tensor, Tensor]]


class StaticFigures(NamedTuple):
    """What the rest state scores on some frames of a sequence, and how much the truth moves there.

    Attributes:
        losses: one per frame.
        motion: squared change of the truth from each frame to the next, one fewer.
    """

    losses: list[float]
    motion: list[float]


@dataclass(frozen=True, eq=False)
class Sources:
    """What a run has at hand for the making of its supervision.

    Attributes:
        scenes: the rest scenes.
        truth: true motion of a sequence by its number, None where it is not known.
        motions: smooth motions that the model can carry, of a scene by its number; None where it has no such basis.
        renderer: draws.
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


class ImageSupervision:
    """Draws predictions in a sample's cameras and compares them with its frames.

    Attributes:
        renderer: draws.
        loss: compares.
        looks: appearance of the scenes.
        views: tells which sequences can be drawn together.
    """

    def __init__(self, scenes: Sequence[GaussianScene], renderer: Renderer, loss: ImageLoss) -> None:
        self.renderer, self.loss = renderer, loss
        self.looks, self.views = Looks(scenes), Views()
        self._rest: dict[Hashable, Rendered] = {}

    def comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Comparison:
        """What draws and compares the predictions of a batch."""
        return self._comparison(samples, batch, slice(1, None))

    def at_rest(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> Comparison:
        """What compares one step from the rest state with frame 0 of the samples."""
        return self._comparison(samples, batch, slice(0, 1))

    def _comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch, frames: slice) -> Comparison:
        groups = self.views.groups(samples)
        return Comparison(
            self.renderer,
            self.loss,
            batch,
            groups,
            [self.looks.of(group.scene_id, batch.rest) for group in groups],
            [sample.frames[frames] for sample in samples],
            [
                self.rest_image(sample, batch.rest[member.kernels]).rgb[0]
                for sample, member in zip(samples, batch.members, strict=True)
            ],
        )

    def rest_image(self, sample: SequenceSample, rest: Float[Tensor, "K 3"]) -> Rendered:
        """The rest state (one) in a sample's cameras; drawn once per scene and set of cameras."""
        key = self.views.key(sample)
        if key not in self._rest:
            self._rest[key] = draw_rest(self.renderer, self.looks.of(sample.scene_id, rest), rest, sample.cameras)
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
