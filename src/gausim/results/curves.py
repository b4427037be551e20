"""Per-frame figures of an evaluated object, from which tables and plots are computed.

Arrays of ``metrics.npz`` are named ``OBJECT/ROW/METRIC``: image metrics and ``image_energy`` are (S, F, V) over
sequences, frames and views, ``error_3d``, ``track_error``, ``chamfer`` and ``point_energy`` (S, F). NaN pads shorter
sequences. Energies of frame t are those of the step from t-1 to t, and exist for the row ``truth``, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gausim.core import RunError
from gausim.io.npz import read_npz
from gausim.results.pictures import Pictures
from gausim.results.table import STATIC

# Rows of the references with which every table compares: of a body at rest in its pins, in flight, and in hands.
BALLISTIC, FOLLOW_HANDS = "ballistic", "follow hands"
TRUTH = "truth"
IMAGE_ENERGY = "image_energy"
ERROR_3D = "error_3d"
TRACK_ERROR = "track_error"
CHAMFER = "chamfer"
IOU = "iou"
POINT_ENERGY = "point_energy"
# Arrays without a view axis.
POINT_ARRAYS = (ERROR_3D, TRACK_ERROR, CHAMFER, POINT_ENERGY)
_FACTS = "facts"


@dataclass(frozen=True)
class ImageMetricInfo:
    """Name and display of an image metric (value times ``scale``, in ``unit``)."""

    key: str
    label: str
    scale: float
    unit: str
    higher_is_better: bool


@dataclass(frozen=True)
class ObjectFacts:
    """Facts of an evaluated object."""

    name: str  # of the object
    fps: float
    sequences: tuple[str, ...]
    frames: tuple[int, ...]  # number of frames of each sequence
    views: tuple[str, ...]
    train_views: tuple[str, ...]  # views used in training
    first_unseen: int  # first frame not used in training
    methods: tuple[str, ...]  # rows of methods (the others are references)
    metrics: tuple[ImageMetricInfo, ...]
    mean_color: tuple[float, float, float]  # of the true foreground, in [0, 1]
    max_l2: float  # largest per-pixel colour distance of any prediction of the first method
    reference: str = STATIC  # row of the reference that ratios divide by


@dataclass(frozen=True, eq=False)
class ObjectCurves:
    """Facts and arrays of one object: ``values[row][metric]``, of the shapes given above."""

    facts: ObjectFacts
    values: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)  # copied to the summary (efficiency, sources, ...)
    pictures: Pictures | None = None  # of one sequence; stored in another file

    @property
    def rows(self) -> list[str]:
        """Rows of tables, all but the truth."""
        return [row for row in self.values if row != TRUTH]

    def view_indices(self, group: str) -> list[int]:
        """Columns of the view axis of group ``train`` or ``heldout``."""
        trained = [v in self.facts.train_views for v in self.facts.views]
        return [i for i, t in enumerate(trained) if t == (group == "train")]


def finite(value: float) -> float | None:
    """The number as JSON holds it: None if it is NaN or infinite."""
    return float(value) if math.isfinite(value) else None


def save_curves(path: Path, objects: list[ObjectCurves]) -> None:
    """Writes all objects' arrays and facts to one npz (the facts as JSON text, without pickles)."""
    arrays: dict[str, Any] = {}
    for curves in objects:
        arrays[f"{curves.facts.name}/{_FACTS}"] = np.array(msgspec.json.encode(curves.facts).decode())
        for row, metrics in curves.values.items():
            for metric, values in metrics.items():
                arrays[f"{curves.facts.name}/{row}/{metric}"] = values
    np.savez_compressed(path, **arrays)


def load_curves(path: Path) -> list[ObjectCurves]:
    """Reads a file of :func:`save_curves`.

    Raises:
        RunError: the file is missing or malformed.
    """
    try:
        arrays = read_npz(path)
        texts = {n.rsplit("/", 1)[0]: str(array) for n, array in arrays.items() if n.endswith(f"/{_FACTS}")}
        objects = {name: msgspec.json.decode(text, type=ObjectFacts) for name, text in texts.items()}
    except (ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: cannot be read ({error}). Write it with `gausim evaluate RUN`.") from error
    if not objects:
        raise RunError(f"{path}: holds no array '*/{_FACTS}'; expected a metrics.npz of `gausim evaluate RUN`.")
    found = {name: ObjectCurves(facts) for name, facts in objects.items()}
    for name, array in arrays.items():
        owner, row, metric = (*name.rsplit("/", 2), "")[:3]
        if owner in found and metric:
            found[owner].values.setdefault(row, {})[metric] = array
    return list(found.values())
