"""Summary of per-frame figures for tables, and its file.

``metrics.json`` (schema ``gausim.evaluation/1``)::

    {"schema": "gausim.evaluation/1",
     "run": {...},                                    what was evaluated, as the caller states it; where the data
                                                      declare a test part, with its "part" (development or test), and of
                                                      the test part the declared "trials" and the number of "looks"
     "provenance": {"gausim", "torch", "python", "machine", "commit", "modified"},  of the program that evaluated
     "objects": {NAME: {
        "fps", "sequences", "frames", "views", "train_views", "heldout_views", "methods",
        "reference": ROW,                             the row that ratios divide by: static, ballistic, follow hands
        "splits": {"seen": [0, 16], "unseen": [16, 50], "unseen_near": [16, 26], "unseen_all": [16, 60]},
        "metrics": {KEY: {"label", "scale", "unit", "higher_is_better"}},
        "contrast": {"mean_color": [r, g, b], "norm": x, "max_l2": x},
        "floor": {KEY: CELL},                         the reconstruction against frame 0 of every training view
        "rows": {ROW: {SPLIT: {GROUP: {KEY: CELL}}}}, GROUP: train | heldout (views), points (3D)
        "efficiency": {METHOD: {"seconds_per_frame": {"mean", "std"}, "frames", "seconds_per_image", "device",
            "threads", "memory": {"kind", "peak_bytes", "added_bytes", "first_added_bytes"}, "levels": {"counts",
            "predicted", "predictions", "kernels"}}}, memory and levels null where unknown
        "sources": {"root", "scene": {"file", "sha256"}, "masks": {...}, "manifest": {...}},
        "absent": {KEY: why},                         metrics that could not be computed
        "horizon": {"frames": [1, 2, 5, ...], "rows": {ROW: {GROUP: {KEY: [mean, ...]}}}},   by frames ahead
        "bounce": {ROW: {"height", "rise", "height_error", "rise_error", "depth"}},   of free bodies above a floor
        "footnotes": {METHOD: {"extrapolates": bool, "notes": [text, ...], "fit": {"seconds", "cpu_seconds",
            "peak_bytes"}, "largest_eigenvalue": x}}          fit null where it was not counted; the eigenvalue is of
                                                      the step linearised at rest, only of simulators with a network
        "diagnosis": {"share": [...], "frequency": [Hz, ...], "rows": {ROW: {"spectrum", "frequencies": [Hz, ...],
            "dampings": [...], "phase_error": [degrees, ...], "velocity_cosine": x,
            "level_errors": [x, ...]}}}                where the true motion is known
     }}}

A CELL is ``{"mean", "std", "ratio"}``: mean and standard deviation over sequences (of the mean over frames and views
of a sequence) and the mean divided by the reference row's (null for the floor and for what is better when higher). Ends
of splits are exclusive. The cell of ``motion_energy`` has besides ``"pooled"``: predicted over true energy summed over
all sequences, which no single sequence at rest can spoil; its mean and std are over the sequences' own ratios and its
ratio is null. Undefined numbers are null. ``footnotes`` are notes on a method and the cost of its training; a method
that does not extrapolate repeats its fitted motion beyond the training frames. ``diagnosis`` describes motion in the
principal motions of the truth: the fraction (``share``) of the squared displacement, ``frequencies`` and ``dampings``
(of critical) of each; power per ``frequency`` over all of them; ``phase_error`` per frame; ``level_errors`` of the
units' centres over static's, at each level of a hierarchy, the finest first; the truth is a row. ``horizon``
has the mean of the frame that is so many frames after the last seen one, over sequences and views. ``bounce`` is of the
points' centre: its highest point above the floor after the first contact and above its lowest point before, the mean
relative errors of both, and the deepest point of all below the floor [% of diagonal]; the truth is a row.
``provenance``, ``efficiency``, ``sources``, ``absent``, ``footnotes``, ``diagnosis``, ``reference``, ``horizon`` and
``bounce`` are not in files of earlier versions.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gausim.core import RunError
from gausim.io.files import write_json
from gausim.io.plain_json import parse_json
from gausim.results.curves import (
    CHAMFER,
    ERROR_3D,
    IMAGE_ENERGY,
    POINT_ARRAYS,
    POINT_ENERGY,
    STATIC,
    TRACK_ERROR,
    TRUTH,
    ObjectCurves,
    finite,
)

# Frames after the last seen one, of the entry ``horizon``.
AHEAD = (1, 2, 5, 10, 20, 30, 50, 100)
SCHEMA = "gausim.evaluation/1"
MOTION_ENERGY = "motion_energy"
# End of the shorter of the paper's two test ranges, which every READY sequence has.
HEADLINE_STOP = 50
# First unseen frames, where errors are still smaller than the motion.
NEAR_FRAMES = 10

_POINT_METRICS = {
    ERROR_3D: {"label": "3D error", "scale": 1.0, "unit": "% of diagonal", "higher_is_better": False},
    TRACK_ERROR: {"label": "track error", "scale": 1e3, "unit": "1e-3 scene units", "higher_is_better": False},
    CHAMFER: {"label": "Chamfer distance", "scale": 1e3, "unit": "1e-3 scene units", "higher_is_better": False},
    MOTION_ENERGY: {"label": "motion energy", "scale": 1.0, "unit": "", "higher_is_better": None},
}


class _Metric(msgspec.Struct):
    label: str
    scale: float
    unit: str
    higher_is_better: bool | None


class _Contrast(msgspec.Struct):
    mean_color: tuple[float, float, float]
    norm: float
    max_l2: float


class _Object(msgspec.Struct):
    """The fields that tables need; files of earlier versions have no others."""

    sequences: list[str]
    splits: dict[str, tuple[int, int]]
    metrics: dict[str, _Metric]
    rows: dict[str, dict[str, dict[str, dict[str, dict[str, float | None]]]]]
    methods: list[str]
    contrast: _Contrast | None = None
    absent: dict[str, str] = {}
    reference: str = STATIC


class _Summary(msgspec.Struct):
    run: dict[str, Any]
    objects: dict[str, _Object]


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


def summarise(curves: ObjectCurves) -> dict[str, Any]:
    """The entry of one object in ``metrics.json``."""
    facts = curves.facts
    splits = frame_splits(max(facts.frames), facts.first_unseen)
    groups = {g: curves.view_indices(g) for g in ("train", "heldout")}
    metrics = {m.key: {key: value for key, value in vars(m).items() if key != "key"} for m in facts.metrics}
    color = [float(c) for c in facts.mean_color]
    return {
        "fps": facts.fps,
        "sequences": list(facts.sequences),
        "frames": list(facts.frames),
        "views": list(facts.views),
        "train_views": [facts.views[i] for i in groups["train"]],
        "heldout_views": [facts.views[i] for i in groups["heldout"]],
        "methods": list(facts.methods),
        "reference": facts.reference,
        "splits": {name: list(split) for name, split in splits.items()},
        "metrics": metrics | _POINT_METRICS,
        "contrast": {"mean_color": color, "norm": math.hypot(*color), "max_l2": facts.max_l2},
        "floor": _floor(curves, groups["train"]),
        "rows": {row: _row(curves, row, splits, groups) for row in curves.rows},
        "horizon": _horizon(curves, groups),
        **curves.record,
    }


def _floor(curves: ObjectCurves, views: list[int]) -> dict[str, Any]:
    reference = curves.values.get(curves.facts.reference)
    if not views or reference is None:
        return {}
    frame0 = {m.key: reference[m.key][:, 0][:, views].mean(1) for m in curves.facts.metrics}
    return {key: _cell(values) for key, values in frame0.items()}


def _row(
    curves: ObjectCurves, row: str, splits: dict[str, tuple[int, int]], groups: dict[str, list[int]]
) -> dict[str, Any]:
    """Cells of one row: split -> group -> metric; groups without data are left out."""
    result: dict[str, Any] = {}
    references = curves.values.get(curves.facts.reference, {})
    without_ratio = {m.key for m in curves.facts.metrics if m.higher_is_better}  # one of decibels has no meaning
    for split, (start, stop) in splits.items():
        cells: dict[str, dict[str, Any]] = {}
        for metric, values in curves.values[row].items():
            for group, views in _places(metric, groups).items():
                window = _window(values, start, stop, views)
                if metric in (IMAGE_ENERGY, POINT_ENERGY):
                    true = _window(curves.values[TRUTH][metric], start, stop, views)
                    cells.setdefault(group, {})[MOTION_ENERGY] = _energy_cell(window, true)
                else:
                    base = None if metric in without_ratio else references.get(metric)
                    reference = None if base is None else _means(_window(base, start, stop, views))
                    cells.setdefault(group, {})[metric] = _cell(_means(window), reference)
        result[split] = cells
    return result


def _horizon(curves: ObjectCurves, groups: dict[str, list[int]]) -> dict[str, Any]:
    """Errors by frames ahead: how far after the last seen frame a prediction still holds."""
    last = curves.facts.first_unseen - 1
    ahead = [n for n in AHEAD if last + n < max(curves.facts.frames)]
    rows: dict[str, dict[str, dict[str, list[float | None]]]] = {}
    for row in curves.rows if ahead else ():
        found = rows.setdefault(row, {})
        for metric, values in curves.values[row].items():
            if metric not in (IMAGE_ENERGY, POINT_ENERGY):
                frames = np.moveaxis(values[:, [last + n for n in ahead]], 1, 0)  # None where every sequence has ended
                for group, views in _places(metric, groups).items():
                    means = _means((frames if views is None else frames[..., views]).reshape(len(ahead), -1))
                    found.setdefault(group, {})[metric] = [finite(float(mean)) for mean in means]
    return {"frames": ahead, "rows": rows}


def _places(metric: str, groups: dict[str, list[int]]) -> dict[str, list[int] | None]:
    """Groups of views in which a metric is, each with its columns."""
    return {"points": None} if metric in POINT_ARRAYS else {group: views for group, views in groups.items() if views}


def _window(values: np.ndarray, start: int, stop: int, views: list[int] | None) -> np.ndarray:
    """(S, all other axes) of the chosen frames and views."""
    window = values[:, start:stop] if views is None else values[:, start:stop][:, :, views]
    return window.reshape(len(values), -1)


def _means(values: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a sequence that ends before the split has no mean
        return np.nanmean(values, axis=1)


def _cell(values: np.ndarray, reference: np.ndarray | None = None) -> dict[str, float | None]:
    defined = values[~np.isnan(values)]
    mean = float(defined.mean()) if len(defined) else math.nan
    std = float(defined.std()) if len(defined) else math.nan
    ratio = math.nan
    if reference is not None and not np.isnan(reference).all() and np.nanmean(reference) > 0:
        ratio = mean / float(np.nanmean(reference))
    return {"mean": finite(mean), "std": finite(std), "ratio": finite(ratio)}


def _energy_cell(predicted: np.ndarray, true: np.ndarray) -> dict[str, float | None]:
    both = ~(np.isnan(predicted) | np.isnan(true))
    p, t = (np.where(both, v, 0.0).sum(1) for v in (predicted, true))
    own = np.divide(p, t, out=np.full_like(p, np.nan), where=t > 0)
    pooled = float(p.sum() / t.sum()) if t.sum() > 0 else math.nan
    return {**_cell(own), "ratio": None, "pooled": finite(pooled)}


def write_summary(
    path: Path, objects: list[ObjectCurves], run: dict[str, Any], *, provenance: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Writes ``metrics.json`` and returns its data."""
    entries = {c.facts.name: summarise(c) for c in objects}
    summary = {"schema": SCHEMA, "run": run, "provenance": provenance or {}, "objects": entries}
    write_json(path, summary)
    return summary


def load_summary(path: Path) -> dict[str, Any]:
    """Reads a ``metrics.json``.

    Raises:
        RunError: the file is missing, not JSON or of another schema, or a field of tables is missing or malformed.
    """
    try:
        summary = parse_json(path.read_bytes())
    except FileNotFoundError:
        raise RunError(f"{path}: no such file. Write it with `gausim evaluate RUN`.") from None
    except ValueError as error:
        raise RunError(f"{path}: cannot be read as JSON ({error}). Run `gausim evaluate RUN` again.") from error
    found = summary.get("schema") if isinstance(summary, dict) else None
    if found != SCHEMA:
        raise RunError(f"{path}: field 'schema' is {found!r}, expected {SCHEMA!r}. Run `gausim evaluate RUN` again.")
    try:
        msgspec.convert(summary, _Summary)
    except msgspec.ValidationError as error:
        raise RunError(f"{path}: {error}. Run `gausim evaluate RUN` again.") from error
    return dict(summary)


def dig(node: Any, *keys: str) -> Any:
    """The value in nested dictionaries under these keys; None if there is none."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node
