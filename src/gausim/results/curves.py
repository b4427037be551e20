"""Per-frame figures of an evaluated object, from which tables and plots are computed.

Arrays of ``metrics.npz`` are named ``OBJECT/ROW/METRIC``: image metrics and ``image_energy`` are (S, F, V) over
sequences, frames and views (training views first), ``error_3d``, ``track_error``, ``chamfer`` and ``point_energy``
(S, F). NaN pads shorter sequences. Energies of frame t are those of the step from t-1 to t, and exist for the row
``truth``, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gausim.core import RunError
from gausim.io.files import replacing
from gausim.io.npz import read_npz
from gausim.results.table import ObjectInfo

# Rows of the references with which tables compare bodies in flight, and in hands.
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


@dataclass(frozen=True)
class ImageMetricInfo:
    """Name and display of an image metric (value times ``scale``, in ``unit``)."""

    key: str
    label: str
    scale: float
    unit: str
    higher_is_better: bool


@dataclass(frozen=True, eq=False)
class ObjectCurves:
    """Facts and arrays of one object: ``values[row][metric]``, of the shapes given above."""

    name: str
    info: ObjectInfo
    values: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    metrics: tuple[ImageMetricInfo, ...] = ()
    costs: dict[str, dict[str, Any]] = field(default_factory=dict)  # of every method
    bounces: dict[str, dict[str, float | None]] = field(default_factory=dict)  # of every row and the truth

    @property
    def rows(self) -> list[str]:
        """Rows of tables, all but the truth."""
        return [row for row in self.values if row != TRUTH]

    @property
    def first_unseen(self) -> int:
        """The first frame that training did not see."""
        return self.info.splits["seen"][1]

    def view_indices(self, group: str) -> list[int]:
        """Columns of the view axis of group ``train`` or ``heldout``."""
        trained, heldout = len(self.info.train_views), len(self.info.heldout_views)
        return list(range(trained)) if group == "train" else list(range(trained, trained + heldout))


def save_curves(path: Path, objects: Sequence[ObjectCurves]) -> None:
    """Writes all objects' arrays to one npz."""
    arrays: dict[str, Any] = {
        f"{curves.name}/{row}/{metric}": values
        for curves in objects
        for row, metrics in curves.values.items()
        for metric, values in metrics.items()
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def load_curves(path: Path, objects: Mapping[str, ObjectInfo]) -> dict[str, ObjectCurves]:
    """Reads a file of :func:`save_curves` of these objects.

    Raises:
        RunError: the file is missing or malformed, or has no array of an object.
    """
    found = {name: ObjectCurves(name, info) for name, info in objects.items()}
    try:
        arrays = read_npz(path)
    except ValueError as error:
        raise RunError(f"{path}: cannot be read ({error}). Write it with `gausim evaluate RUN`.") from error
    for name, array in arrays.items():
        owner, row, metric = (*name.rsplit("/", 2), "", "")[:3]
        if owner in found and metric:
            found[owner].values.setdefault(row, {})[metric] = array
    if absent := [name for name, curves in found.items() if not curves.values]:
        raise RunError(f"{path}: holds no arrays of {absent}. Write it with `gausim evaluate RUN`.")
    return found
