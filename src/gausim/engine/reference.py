"""What the static prediction scores on each training sequence and how much the truth moves: yardsticks of training."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from gausim.core import Renderer
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.engine.rollout import Views, draw_rest
from gausim.losses.image import ImageLoss
from gausim.render.draw import SceneAppearance


@dataclass
class Yardstick:
    """Constants of one sequence, as far as its frames have been seen.

    Attributes:
        floor: image loss of the rest state on frame 0, what the reconstruction itself leaves.
        static: image loss of the rest state on frames 1, 2, ...
        motion: sum over pixels of the squared change of the true image from frame t to t + 1.
    """

    floor: float = 0.0
    static: list[float] = field(default_factory=list)
    motion: list[float] = field(default_factory=list)


class Yardsticks:
    """Measures each sequence once; later batches look the numbers up."""

    def __init__(self, renderer: Renderer, loss: ImageLoss, views: Views) -> None:
        """Keeps what draws, what measures and what tells cameras apart."""
        self._renderer, self._loss, self._views = renderer, loss, views
        self._rest: dict[Hashable, Tensor] = {}
        self._known: dict[int, Yardstick] = {}

    def rest_image(self, sample: SequenceSample, look: SceneAppearance, rest: Tensor) -> Tensor:
        """Images of the rest state in a sample's cameras, (V, H, W, 3); drawn once per scene and set of cameras."""
        key = self._views.key(sample)
        if key not in self._rest:
            self._rest[key] = draw_rest(self._renderer, look, rest, sample.cameras)
        return self._rest[key]

    def of(self, sample: SequenceSample, look: SceneAppearance, rest: Tensor) -> Yardstick:
        """The yardstick of a sample's sequence, for at least the sample's frames."""
        known = self._known.setdefault(sample.sequence_id, Yardstick())
        seen = len(known.static)
        if seen < sample.steps:
            with torch.no_grad():
                image = self.rest_image(sample, look, rest)
                frames = composite(sample.frames[seen:].to(image.device))[0]
                losses = self._loss(image.expand_as(frames), frames).tolist()
                change = (frames[1:] - frames[:-1]).square().sum((1, 2, 3, 4)).tolist()
            if seen == 0:
                known.floor = losses[0]
            known.static += losses[1:]
            known.motion += change
        return known

    def learn(self, sequences: Sequence[int], yards: Sequence[Yardstick]) -> None:
        """Takes what the ranks found, so that each knows what one rank alone would."""
        self._known.update(zip(sequences, yards, strict=True))

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """What is known of each sequence: measured with other frames at once, the last bits would differ."""
        return {sequence: asdict(known) for sequence, known in self._known.items()}

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """Continues with what ``state`` knew."""
        self._known = {sequence: Yardstick(**known) for sequence, known in state.items()}
