"""The recorded videos beside the simulation: the true frame, and the shown one drawn by the same camera."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import UInt8

from gausim.core import GaussianScene, Renderer
from gausim.data.images import composite
from gausim.data.records import SequenceRecord
from gausim.render.draw import SceneAppearance, draw, to_bytes
from gausim.viewer.shown import Shown

# True frames kept decoded.
_KEPT = 64


class Films:
    """Videos of an object's sequences.

    Attributes:
        views: names of the cameras.
    """

    def __init__(self, records: Mapping[str, SequenceRecord], scene: GaussianScene, renderer: Renderer) -> None:
        """Takes the sequences by name, the rest scene and what draws it."""
        self._records, self._renderer = dict(records), renderer
        self._look = SceneAppearance.of(scene, scene.foreground)
        self._known: OrderedDict[tuple[str, str, int], np.ndarray] = OrderedDict()
        first = next(iter(self._records.values()))
        self.views: tuple[str, ...] = tuple(first.views)

    def truth(self, sequence: str, view: str, number: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The recorded frame over black; None after the recording's end."""
        record = self._records[sequence]
        if number >= record.count:
            return None
        key = (sequence, view, number)
        if key not in self._known:
            rgb, _ = composite(record.frames(range(number, number + 1), [view])[:, 0])
            self._known[key] = to_bytes(rgb[0]).numpy()
            if len(self._known) > _KEPT:
                self._known.popitem(last=False)
        return self._known[key]

    @torch.no_grad()
    def drawn(self, sequence: str, view: str, shown: Shown) -> UInt8[np.ndarray, "H W 3"]:
        """The shown frame as that camera sees it, over black."""
        frame = shown.frame
        image = draw(
            self._renderer, self._look, frame.positions[None], frame.deformation_gradients[None], frame.rotations[None],
            shown.unit_of_kernel, self._records[sequence].cameras_of([view]),
        ).rgb[0, 0]  # fmt: skip
        return to_bytes(image).cpu().numpy()
