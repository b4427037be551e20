"""Errors by frames ahead: how far after the last seen frame a prediction still holds."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np

from gausim.results.curves import IMAGE_ENERGY, POINT_ARRAYS, POINT_ENERGY, ObjectCurves

# Frames after the last seen one.
AHEAD = (1, 2, 5, 10, 20, 30, 50, 100)


def horizon(curves: ObjectCurves) -> dict[str, Any]:
    """The entry ``horizon`` of an object in ``metrics.json``."""
    last = curves.facts.first_unseen - 1
    ahead = [n for n in AHEAD if last + n < max(curves.facts.frames)]
    rows: dict[str, dict[str, dict[str, list[float | None]]]] = {}
    for row in curves.rows if ahead else ():
        groups = rows.setdefault(row, {})
        for metric, values in curves.values[row].items():
            if metric in (IMAGE_ENERGY, POINT_ENERGY):
                continue
            chosen = values[:, [last + n for n in ahead]]
            if metric in POINT_ARRAYS:
                groups.setdefault("points", {})[metric] = _means(chosen)
                continue
            for group in ("train", "heldout"):
                if views := curves.view_indices(group):
                    groups.setdefault(group, {})[metric] = _means(chosen[:, :, views])
    return {"frames": ahead, "rows": rows}


def _means(values: np.ndarray) -> list[float | None]:
    """Mean over all axes but that of frames; None where every sequence has ended."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        means = np.nanmean(np.moveaxis(values, 1, 0).reshape(values.shape[1], -1), axis=1)
    return [float(mean) if math.isfinite(mean) else None for mean in means]
