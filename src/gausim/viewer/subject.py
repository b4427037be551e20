"""The contents of a viewer, recorded videos among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from gausim.core import Cameras, GaussianScene, Renderer
from gausim.data.images import composite
from gausim.data.records import SequenceRecord
from gausim.interaction.interaction import Interaction
from gausim.models.template.template import Property
from gausim.render.draw import SceneAppearance, draw, to_bytes
from gausim.viewer.live import Companion
from gausim.viewer.shown import Shown, Take

# Number of decoded frames in the cache.
_KEPT = 64


class Films:
    """Videos of an object's sequences.

    Attributes:
        views: names of the cameras.
    """

    def __init__(self, records: Mapping[str, SequenceRecord], scene: GaussianScene, renderer: Renderer) -> None:
        """Takes the sequences by name, the rest scene and its renderer."""
        self._records, self._renderer = dict(records), renderer
        self._look = SceneAppearance.of(scene, scene.foreground)
        self._decoded = lru_cache(_KEPT)(self._decode)
        self.views: tuple[str, ...] = tuple(next(iter(self._records.values())).views)

    def truth(self, sequence: str, view: str, number: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The recorded frame on black; None after the end of the recording, or of what a sealed test part shows."""
        return self._decoded(sequence, view, number) if number < self._records[sequence].visible else None

    def _decode(self, sequence: str, view: str, number: int) -> np.ndarray:
        rgb, _ = composite(self._records[sequence].frames(range(number, number + 1), [view])[:, 0])
        decoded: np.ndarray = to_bytes(rgb[0]).numpy()
        return decoded

    @torch.no_grad()
    def drawn(self, sequence: str, view: str, shown: Shown) -> UInt8[np.ndarray, "H W 3"]:
        """The shown frame rendered from the camera ``view``, on black."""
        frame = shown.frame
        image = draw(
            self._renderer, self._look, frame.positions[None], frame.deformation_gradients[None], frame.rotations[None],
            shown.unit_of_kernel, self._records[sequence].cameras_of([view]),
        ).rgb[0, 0]  # fmt: skip
        return to_bytes(image).cpu().numpy()


@dataclass(frozen=True, eq=False)
class Subject:
    """The contents of a viewer."""

    title: str  # heading of the page, one line
    interaction: Interaction  # the simulation
    takes: Sequence[Take] = ()  # recordings that can be played
    companion: Companion | None = None  # a second method shown beside the first, or None
    films: Films | None = None  # the recorded videos, or None
    cameras: Cameras | None = None  # cameras of the data set, or None
    material: Mapping[str, Property] = field(default_factory=dict)  # learned properties of the kernels by name
    up: str = "z"  # vertical axis: x, y, z, -x, -y or -z
    sessions: Path = field(default_factory=lambda: Path("sessions"))  # folder of saved sessions
