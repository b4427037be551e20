"""What a segmentation asks of a way to tell foreground from background."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data_prep.capture.masks.segmenters import Segmenter


@dataclass(frozen=True)
class Backend:
    """A way to tell foreground from background, with what its result depends on.

    Attributes:
        name: of the backend.
        make: makes the segmenter; called once, and only if there is something to do.
        soft: masks have soft edges of their own; others are softened along the picture's edges.
        settings: what was chosen (plain data).
        inputs: files it reads besides the pictures.
        packages: libraries whose versions may matter.
    """

    name: str
    make: Callable[[], Segmenter]
    soft: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Path] = field(default_factory=dict)
    packages: tuple[str, ...] = ()
