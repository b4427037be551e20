"""Recorder of an evaluation's small pictures (see :mod:`gausim.results.pictures`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gausim.core import Rendered
from gausim.data.objects import ObjectData
from gausim.results.pictures import Pictures

# Longest side [pixels] and number of cameras, limited because pictures go into web pages.
LONGEST, CAMERAS = 192, 4


class PictureRecorder:
    """Small pictures of one sequence of an object in a few cameras.

    Args:
        data: the object.
        sequence: name of the sequence.
        views: evaluated cameras; up to four are recorded, half of them held-out ones if there are any.
    """

    def __init__(self, data: ObjectData, sequence: str, views: Sequence[str]) -> None:
        heldout = [v for v in views if v in data.heldout_views][: CAMERAS // 2]
        trained = [v for v in views if v not in data.heldout_views][: CAMERAS - len(heldout)]
        self._data, self._sequence = data, sequence
        self._views = [v for v in views if v in (*trained, *heldout)]
        self._heldout = tuple(heldout)
        self._columns = [list(views).index(v) for v in self._views]
        self._truth: list[np.ndarray] = []
        self._drawn: dict[str, list[np.ndarray]] = {}
        # Sum of the colours of every pixel in frames where it is background, and the number of these.
        self._total, self._count = torch.zeros(()), torch.zeros(())

    def add(self, recorded: UInt8[Tensor, "F V H W 4"], drawn: Mapping[str, Rendered]) -> None:
        """Adds the next frames: recorded ones (straight alpha), and the rendered ones of every method."""
        straight = recorded[:, self._columns].float() / 255
        self._truth.append(_small(straight[..., :3] * straight[..., 3:], straight[..., 3]))
        for name, images in drawn.items():
            rgb, alpha = (x[:, self._columns] for x in (images.rgb, images.alpha))
            self._drawn.setdefault(name, []).append(_small(rgb, alpha))
        free = (straight[..., 3:] == 0).float()
        self._total, self._count = self._total + (straight[..., :3] * free).sum(0), self._count + free.sum(0)

    def finish(self) -> Pictures:
        """The pictures of all frames added."""
        return Pictures(
            object=self._data.name,
            sequence=self._sequence,
            fps=self._data.fps,
            first_unseen=self._data.train_frames.stop,
            views=tuple(self._views),
            heldout_views=self._heldout,
            truth=np.concatenate(self._truth),
            predictions={name: np.concatenate(parts) for name, parts in self._drawn.items()},
            background=self._background(),
        )

    def _background(self) -> np.ndarray | None:
        """Mean colour of every pixel over frames in which it is background; None if the files have only black there.

        Pixels that are never background get the mean of the others.
        """
        total, count = self._total, self._count
        if float(total.max()) == 0.0:
            return None
        overall = total.sum((1, 2), keepdim=True) / count.sum((1, 2), keepdim=True).clamp_min(1)
        plate = torch.where(count > 0, total / count.clamp_min(1), overall)
        return _small(plate[None], torch.ones_like(plate[None, ..., 0]))[0, ..., :3]


def _small(rgb: Float[Tensor, "F V H W 3"], alpha: Float[Tensor, "F V H W"]) -> np.ndarray:
    """(F, V, h, w, 4) uint8, the longest side at most LONGEST."""
    images = torch.cat((rgb, alpha[..., None]), -1).detach().float().cpu().clamp(0, 1)
    height, width = images.shape[2:4]
    factor = min(1.0, LONGEST / max(height, width))
    if factor < 1:
        flat = images.flatten(0, 1).permute(0, 3, 1, 2)
        size = (max(1, round(height * factor)), max(1, round(width * factor)))
        flat = torch.nn.functional.interpolate(flat, size=size, mode="area")
        images = flat.permute(0, 2, 3, 1).unflatten(0, images.shape[:2])
    return (images * 255 + 0.5).to(torch.uint8).numpy()
