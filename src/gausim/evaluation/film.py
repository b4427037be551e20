"""The film of an evaluation: truth, prediction and error of one sequence side by side."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from gausim.data.objects import ObjectData
from gausim.io.video import SMALL, write_video
from gausim.pictures.frames import ERROR_RANGE, comparison, shrunk
from gausim.render.draw import to_bytes

ROWS = 480  # of each image


class Film:
    """Collects one sequence of an object in the first held-out view, else in the first view."""

    def __init__(self, data: ObjectData, sequence: str, views: Sequence[str]) -> None:
        heldout = [view for view in views if view in data.heldout_views]
        self._view = (heldout or list(views))[0]
        self._column, self._is_heldout = list(views).index(self._view), bool(heldout)
        self._data, self._sequence = data, sequence
        self._truth, self._prediction = list[np.ndarray](), list[np.ndarray]()

    def add(self, truth: Float[Tensor, "F V H W 3"], prediction: Float[Tensor, "F V H W 3"]) -> None:
        """Adds the next frames, on black."""
        for kept, images in ((self._truth, truth), (self._prediction, prediction)):
            kept.extend(shrunk(to_bytes(images[:, self._column]).cpu().numpy(), ROWS))

    def write(self, path: Path) -> str:
        """Writes the film as MP4; returns its caption."""
        title, unseen = f"{self._data.name} {self._sequence} {self._view}", self._data.train_frames.stop
        frames = comparison(self._truth, self._prediction, title, unseen, height=ROWS)
        write_video(path, frames, self._data.fps, quality=SMALL)
        kind = "held out" if self._is_heldout else "a training view; the evaluation has no other"
        return (
            f"{self._sequence} in {self._view} ({kind}). Error: distance of the colours, from 0 (black) to "
            f"{ERROR_RANGE:g} and more (brightest)."
        )
