"""Summary of the per-frame figures of an object: entries of the long table, and facts."""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gausim.results.curves import (
    BALLISTIC,
    CHAMFER,
    ERROR_3D,
    IMAGE_ENERGY,
    POINT_ARRAYS,
    POINT_ENERGY,
    TRACK_ERROR,
    TRUTH,
    ObjectCurves,
)
from gausim.results.table import INFORMED, METHOD, REFERENCE, Entry, Kind, Metric

# Frames after the last seen one of which errors are kept.
AHEAD = (1, 2, 5, 10, 20, 30, 50, 100)
AHEAD_METRICS = (ERROR_3D, "psnr")
MOTION_ENERGY = "motion_energy"
# End of the shorter of the paper's two test ranges, which every READY sequence has.
HEADLINE_STOP = 50
# First unseen frames, where errors are still smaller than the motion.
NEAR_FRAMES = 10
FLOOR = "reconstruction (floor), frame 0"
RATIO = "_ratio"
_SCALES = {ERROR_3D: 1.0, TRACK_ERROR: 1e3, CHAMFER: 1e3}
_WITHOUT_RATIO = (TRACK_ERROR, MOTION_ENERGY)  # the track error is the 3D error in other units

# Metrics that do not come from the image metrics. Memory of a fit: the most that the training process held; of a
# prediction: what it adds, on a GPU the peak.
METRICS = {
    ERROR_3D: Metric("3D error", "% of diagonal", "low"),
    TRACK_ERROR: Metric("track error", "1e-3 scene units", "low"),
    CHAMFER: Metric("Chamfer distance", "1e-3 scene units", "low"),
    ERROR_3D + RATIO: Metric("3D ÷ {reference}", "", "low", 3),
    MOTION_ENERGY: Metric("motion energy", "", "one"),
    "units": Metric("units", digits=0),
    "fit": Metric("fit", "CPU min", digits=1),
    "fit_wall": Metric("fit, wall", "min", digits=1),
    "fit_memory": Metric("fit, memory", "GB", digits=1),
    "per_frame": Metric("per frame", "s", digits=4),
    "per_image": Metric("per image", "ms"),
    "memory": Metric("prediction, memory", "MB", digits=1),
    "hardware": Metric("on"),
    "height": Metric("highest point after the impact", "scene units", digits=3),
    "height_error": Metric("its error", "%", "low", 1),
    "rise": Metric("rise", "scene units", digits=3),
    "rise_error": Metric("its error", "%", "low", 1),
    "depth": Metric("deepest below the floor", "% of the diagonal"),
}
_BOUNCE = {"height": 1.0, "height_error": 100.0, "rise": 1.0, "rise_error": 100.0, "depth": 1.0}


def frame_splits(frames: int, first_unseen: int) -> dict[str, tuple[int, int]]:
    """Named ranges [first, end) of frames; ``unseen_all`` only if it is longer than ``unseen``."""
    splits = {"seen": (0, min(first_unseen, frames))}
    if frames > first_unseen:
        # Of recordings that are seen nearly as far as the paper's test range, the headline is all that is unseen.
        stop = min(frames, HEADLINE_STOP) if first_unseen + NEAR_FRAMES <= HEADLINE_STOP else frames
        splits["unseen"] = (first_unseen, stop)
        splits["unseen_near"] = (first_unseen, min(first_unseen + NEAR_FRAMES, frames))
        if frames > stop:
            splits["unseen_all"] = (first_unseen, frames)
    return splits


def metrics_of(objects: Sequence[ObjectCurves]) -> dict[str, Metric]:
    """Display of all metrics of evaluated objects."""
    found: dict[str, Metric] = {}
    for info in (info for curves in objects for info in curves.metrics):
        found[info.key] = Metric(info.label, info.unit, "high" if info.higher_is_better else "low")
        if not info.higher_is_better:
            found[info.key + RATIO] = Metric(f"{info.label} ÷ {{reference}}", "", "low", 3)
    return found | {CHAMFER + RATIO: Metric("Chamfer ÷ {reference}", "", "low", 3)} | METRICS


def entries_of(curves: ObjectCurves, seed: Any = None) -> list[Entry]:
    """All figures of an evaluated object, of methods first."""
    methods, reference = curves.info.methods, curves.info.reference
    rows = [*methods, *(row for row in curves.rows if row not in methods)]
    # The linear references are fitted to the true motion, and rigid flight begins again from its last seen frames.
    kinds: dict[str, Kind] = {reference: INFORMED if reference == BALLISTIC else REFERENCE}
    kinds |= {method: METHOD for method in methods}
    found: list[Entry] = []

    def add(row: str, split: str, views: str, figures: Mapping[str, tuple[Any, float | None]]) -> None:
        kind, own = kinds.get(row, INFORMED), seed if row in methods else None
        for metric, (value, deviation) in figures.items():
            if isinstance(value, str) or (value is not None and math.isfinite(value)):
                kept = None if deviation is None or not math.isfinite(deviation) else deviation
                found.append(Entry(row, kind, curves.name, split, views, metric, own, value, kept))

    for row in rows:
        for split, views, figures in _figures(curves, row):
            add(row, split, views, figures)
    for row, split, views, figures in [*_floor(curves), *_bounces(curves), *_costs(curves)]:
        add(row, split, views, figures)
    return found


Figures = dict[str, tuple[Any, float | None]]


def _figures(curves: ObjectCurves, row: str) -> Iterator[tuple[str, str, Figures]]:
    """Figures of a row: split, views, and value and deviation over sequences by metric."""
    scales = {m.key: m.scale for m in curves.metrics} | _SCALES
    higher = {m.key for m in curves.metrics if m.higher_is_better}
    reference = curves.values.get(curves.info.reference, {})
    groups = {g: found for g in ("train", "heldout") if (found := curves.view_indices(g))}
    own = curves.values[row]
    last, frames = curves.first_unseen - 1, max(curves.info.frames)
    ahead = {f"+{n}": (last + n, last + n + 1) for n in AHEAD if last + n < frames}
    for split, span in (curves.info.splits | ahead).items():
        for views, columns in {"points": None, **groups}.items():
            figures: Figures = {}
            for metric, values in own.items():
                if (metric in POINT_ARRAYS) != (columns is None) or (split in ahead and metric not in AHEAD_METRICS):
                    continue
                window = _window(values, span, columns)
                if metric in (IMAGE_ENERGY, POINT_ENERGY):
                    true = _window(curves.values[TRUTH][metric], span, columns)
                    figures[MOTION_ENERGY] = _energy(window, true), None
                    continue
                mean, deviation = _moments(_means(window))
                deviation = None if split in ahead else deviation
                figures[metric] = mean * scales[metric], None if deviation is None else deviation * scales[metric]
                if split not in ahead and metric not in (*higher, *_WITHOUT_RATIO) and metric in reference:
                    base, _ = _moments(_means(_window(reference[metric], span, columns)))
                    ratio = mean / base if base > 0 else math.nan
                    spread = deviation * ratio / mean if deviation is not None and mean else None
                    figures[metric + RATIO] = ratio, spread
            yield split, views, {m: figures[m] for m in sorted(figures, key=lambda m: m == MOTION_ENERGY)}


def _window(values: np.ndarray, span: tuple[int, int], columns: list[int] | None) -> np.ndarray:
    """(S, all other axes) of the chosen frames and views."""
    window = values[:, slice(*span)] if columns is None else values[:, slice(*span)][:, :, columns]
    return window.reshape(len(values), -1)


def _means(values: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a sequence that ends before the split has no mean
        return np.nanmean(values, axis=1)


def _moments(values: np.ndarray) -> tuple[float, float | None]:
    """Mean and deviation over sequences; no deviation of a single sequence."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else math.nan, float(defined.std()) if len(defined) > 1 else None


def _energy(predicted: np.ndarray, true: np.ndarray) -> float:
    """Predicted over true energy, all sequences together, which no single sequence at rest can spoil."""
    both = ~(np.isnan(predicted) | np.isnan(true))
    total = float(true[both].sum())
    return float(predicted[both].sum()) / total if total > 0 else math.nan


Rows = Iterator[tuple[str, str, str, Figures]]


def _floor(curves: ObjectCurves) -> Rows:
    """The reconstruction against frame 0 of every training view."""
    reference, views = curves.values.get(curves.info.reference), curves.view_indices("train")
    if reference is not None and views:
        metrics = [m for m in curves.metrics if m.key in reference]
        moments = {m.key: (m.scale, *_moments(reference[m.key][:, 0][:, views].mean(1))) for m in metrics}
        yield (
            FLOOR,
            "seen",
            "train",
            {key: (scale * mean, None if std is None else scale * std) for key, (scale, mean, std) in moments.items()},
        )


def _bounces(curves: ObjectCurves) -> Rows:
    for row, found in curves.bounces.items():
        scaled = {key: _times(scale, found[key]) for key, scale in _BOUNCE.items()}
        yield row, "bounce", "points", {key: (value, None) for key, value in scaled.items()}


def _costs(curves: ObjectCurves) -> Rows:
    """Units, time and memory of every method's predictions and training."""
    for row, cost in curves.costs.items():
        fit, memory = cost.get("fit") or {}, cost.get("memory") or {}
        on_gpu = str(memory.get("kind")).startswith("CUDA")
        counts = (cost.get("levels") or {}).get("counts")
        values = {
            "units": " → ".join(map(str, counts)) if counts else None,
            "fit": _times(1 / 60, fit.get("cpu_seconds")),
            "fit_wall": _times(1 / 60, fit.get("seconds")),
            "fit_memory": _times(1e-9, fit.get("peak_bytes")),
            "per_frame": cost.get("seconds_per_frame"),
            "per_image": _times(1e3, cost.get("seconds_per_image")),
            "memory": _times(1e-6, memory.get("peak_bytes" if on_gpu else "added_bytes")),
            "hardware": f"{cost['device']}, {cost['threads']} threads" if "device" in cost else None,
        }
        yield row, "", "", {metric: (value, None) for metric, value in values.items()}


def _times(scale: float, value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(scale * value)
