"""Evaluation of predictions of an object against its videos and, where known, its true 3D motion.

It needs no run: any callable that returns a :class:`Trajectory` of a sequence can be evaluated beside the references
(a prediction without dynamics, linear AR(p) on the true states). Frames are processed in chunks; per-frame figures are
kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim import metrics
from gausim.baselines.linear_ar import LinearAR, choose_linear_ar, fit_linear_ar
from gausim.core import Cameras, DataError, GaussianScene, Rendered, Renderer, RunError, Trajectory
from gausim.data.images import composite
from gausim.data.objects import ObjectData
from gausim.data.records import GroundTruth, SequenceRecord
from gausim.evaluation.markdown import markdown
from gausim.evaluation.recorder import PictureRecorder
from gausim.evaluation.references import Bounces, Reference
from gausim.metrics.lpips import NO_WEIGHTS, SMALLEST, TOO_SMALL, weights_path
from gausim.render.draw import SceneAppearance, draw
from gausim.results.curves import (
    CHAMFER,
    ERROR_3D,
    IMAGE_ENERGY,
    IOU,
    POINT_ENERGY,
    TRACK_ERROR,
    TRUTH,
    ImageMetricInfo,
    ObjectCurves,
    ObjectFacts,
    save_curves,
)
from gausim.results.diagnosis import Diagnosis
from gausim.results.pictures import save_pictures
from gausim.results.summary import entries_of, info_of, metrics_of
from gausim.results.table import SCHEMA, STATIC, Results, save_results
from gausim.runs.cost import CostMeter
from gausim.runs.provenance import code_provenance, data_provenance
from gausim.training.supervision.points import attach_points

# Predicts every frame of a sequence (count frames, frame 0 first) for all kernels of the scene. Its optional attributes
# ``levels`` (plain data: counts, predicted, predictions, kernels) and ``footnotes`` (extrapolates, notes) are stored in
# the summary; with ``units`` (the unit of every kernel, level by level) its error is also computed by level.
Predict = Callable[[SequenceRecord], Trajectory]
Rows = dict[str, dict[str, np.ndarray]]

# Modes of the linear references: few for robustness, more for finer motion. Frames that the last one remembers.
AR_MODES, AR_MEMORY = (8, 24), 4
MASK_IOU = ImageMetricInfo(IOU, "mask IoU", 1.0, "", higher_is_better=True)
# Pixels that are rendered and compared at once: about 100 MB of float images and their filters.
PIXELS_AT_ONCE = 1 << 20


def default_metrics(side: int = SMALLEST, *, flip: bool = False) -> list[metrics.ImageMetric]:
    """The image metrics of tables for images of ``side`` pixels, with LPIPS where it is available.

    Raises:
        ConfigError: FLIP is wanted and not installed.
    """
    basic = (metrics.L2, metrics.ForegroundL2, metrics.PSNR, metrics.ForegroundPSNR, metrics.SSIM)
    optional = [metrics.FLIP] * flip + [metrics.LPIPS] * (not absent_metrics(side))
    return [kind() for kind in (*basic, *optional)]


def absent_metrics(side: int) -> dict[str, str]:
    """Reason by key why LPIPS cannot be computed on images of ``side`` pixels; empty where it can."""
    reason = TOO_SMALL if side < SMALLEST else "" if weights_path().is_file() else NO_WEIGHTS
    return {metrics.LPIPS.key: reason} if reason else {}


@dataclass(frozen=True, eq=False)
class _Task:
    """What is measured of an object, and with what."""

    data: ObjectData
    scene: GaussianScene
    methods: Mapping[str, Predict]
    renderer: Renderer
    views: list[str]
    metrics: list[metrics.ImageMetric]
    reference: Reference
    look: SceneAppearance
    attached: Tensor | None  # the kernel of every true point
    linear: dict[str, LinearAR]


class _Totals:
    """Quantities over all sequences: colour of the foreground, largest l2, costs, oscillation and bounces."""

    def __init__(self, task: _Task) -> None:
        self.max_l2 = 0.0
        self.color = torch.zeros(4, dtype=torch.float64)  # sum of the true foreground's colours, and its pixels
        self.costs = {name: CostMeter() for name in task.methods}
        self.diagnosis = Diagnosis(task.data.fps)
        self.bounces = Bounces(task.data)


def evaluate_object(
    data: ObjectData,
    scene: GaussianScene,
    methods: Mapping[str, Predict],
    renderer: Renderer,
    *,
    sequences: Sequence[str] | None = None,
    views: Sequence[str] | None = None,
    flip: bool = False,
    advance: Callable[[str], None] | None = None,
) -> ObjectCurves:
    """Per-frame figures of every method (a prediction by its row) and reference on every sequence of an object.

    The rest scene has all kernels of the trajectories. Sequences and views are all, unless named; ``flip`` measures
    FLIP, too, in as much time as everything else. ``advance`` is called with a sequence's name when it is done.

    Raises:
        ConfigError: FLIP is wanted and not installed.
        DataError: an unknown sequence, or broken data.
        RunError: a prediction has a wrong number of frames or kernels, or is not finite.
    """
    records = _chosen(data, sequences)  # before the task, which reads the true motion of all
    side = min(side for r in data.sequences for side in (r.cameras.width, r.cameras.height))
    reference, points = Reference(data, scene), data.rest_points
    task = _Task(
        data, scene, methods, renderer, list(data.views if views is None else views), default_metrics(side, flip=flip),
        reference, SceneAppearance.of(scene, scene.foreground),
        None if points is None else attach_points(scene, points),
        _linear_references(data) if reference.name == STATIC else {},
    )  # fmt: skip
    totals, results, pictures = _Totals(task), list[Rows](), PictureRecorder(data, records[0].name, task.views)
    for record in records:
        # A separate record, so that its decoded frames are freed with it.
        results.append(_sequence(task, totals, data.record(record.name), pictures if record is records[0] else None))
        if advance is not None:
            advance(record.name)
    r, g, b = (totals.color[:3] / totals.color[3].clamp_min(1)).tolist()
    shown = [ImageMetricInfo(m.key, m.label, m.scale, m.unit, bool(m.higher_is_better)) for m in task.metrics]
    facts = ObjectFacts(
        name=data.name,
        fps=data.fps,
        sequences=tuple(r.name for r in records),
        frames=tuple(r.count for r in records),
        views=tuple(task.views),
        train_views=tuple(v for v in task.views if v in data.train_views),
        first_unseen=data.train_frames.stop,
        methods=tuple(methods),
        metrics=(*shown, MASK_IOU),
        mean_color=(r, g, b),
        max_l2=totals.max_l2,
        reference=task.reference.name,
    )
    return ObjectCurves(facts, _stack(results), _record(task, totals, absent_metrics(side)), pictures.finish())


def write_evaluation(folder: Path, objects: list[ObjectCurves], run: dict[str, Any]) -> Results:
    """Writes metrics.json, metrics.npz, pictures.npz and table.md to ``folder``; returns the content of metrics.json.

    ``run`` is what was evaluated; its ``seed`` is that of the methods' entries.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_curves(folder / "metrics.npz", objects)
    save_pictures(folder / "pictures.npz", [c.pictures for c in objects if c.pictures is not None])
    results = results_of(objects, run)
    save_results(folder / "metrics.json", results)
    (folder / "table.md").write_text(markdown(results))
    return results


def results_of(objects: Sequence[ObjectCurves], run: dict[str, Any]) -> Results:
    """The long table of evaluated objects."""
    table = [entry for curves in objects for entry in entries_of(curves, run.get("seed"))]
    infos = {curves.facts.name: info_of(curves) for curves in objects}
    known = code_provenance()
    return Results(SCHEMA, run=run, provenance=known, objects=infos, metrics=metrics_of(objects), table=table)


def _record(task: _Task, totals: _Totals, absent: dict[str, str]) -> dict[str, Any]:
    """Besides the figures: costs of every method, hashes of the data, absent metrics, oscillation, bounces."""
    levels, footnotes = _told(task, "levels"), _told(task, "footnotes")
    facts = {
        "efficiency": {name: {**meter.summary(), "levels": levels[name]} for name, meter in totals.costs.items()},
        "sources": data_provenance(task.data),
        "absent": absent,
        "footnotes": {name: found for name, found in footnotes.items() if found is not None},
        "diagnosis": totals.diagnosis.summary(),
        "bounce": totals.bounces.summary(),
    }
    return {key: found for key, found in facts.items() if found is not None}


def _told(task: _Task, attribute: str) -> dict[str, Any]:
    """An optional attribute of every method, None where it has none."""
    return {name: getattr(predict, attribute, None) for name, predict in task.methods.items()}


def _chosen(data: ObjectData, names: Sequence[str] | None) -> list[SequenceRecord]:
    known = {r.name: r for r in data.sequences}
    unknown = [n for n in names or () if n not in known]
    if unknown:
        raise DataError(f"{data.root}: has no sequence {unknown}; it has {list(known)}.")
    return data.sequences if names is None else [known[n] for n in names]


def _linear_references(data: ObjectData) -> dict[str, LinearAR]:
    """Linear AR(2) and AR(4) about the rest state, fitted to the seen frames of every sequence whose truth is known."""
    shown = [record for record in data.sequences if record.limit is None]
    truths = [t for t in (data.ground_truth(record) for record in shown) if t is not None]
    seen = [(t.positions - t.rest)[: data.train_frames.stop] for t in truths]
    if not seen or min(len(d) for d in seen) < 3:
        return {}
    found = {f"linear AR(2) on true states, {m} modes": fit_linear_ar(seen, m) for m in AR_MODES}
    if min(len(d) for d in seen) > AR_MEMORY:
        found[f"linear AR({AR_MEMORY}) on true states"] = choose_linear_ar(seen, AR_MODES, AR_MEMORY)
    return found


@torch.no_grad()
def _sequence(task: _Task, totals: _Totals, record: SequenceRecord, pictures: PictureRecorder | None) -> Rows:
    """Figures of one sequence, (F, V) and (F,) per row and metric; adds the frames to ``pictures``."""
    trajectories = {}
    for name, predict in task.methods.items():
        made = totals.costs[name].predict(partial(predict, record), record.count - 1)
        trajectories[name] = _checked(task, name, record, made)
    truth = task.data.ground_truth(record)
    reference = task.reference.trajectory(record, truth)
    device = next((made.positions.device for made in trajectories.values()), reference.positions.device)
    rows = _images(task, totals, record, trajectories, reference.to(device), pictures)
    if truth is not None:
        moved = {name: trajectory.to("cpu") for name, trajectory in trajectories.items()}
        _points(task, totals, rows, {**moved, task.reference.name: reference}, truth)
    return rows


def _checked(task: _Task, name: str, record: SequenceRecord, trajectory: Trajectory) -> Trajectory:
    expected, actual = (record.count, task.scene.count), tuple(trajectory.positions.shape[:2])
    if actual != expected:
        raise RunError(f"{name}, {record.name}: predicted (frames, kernels) = {actual}, expected {expected}.")
    broken = ~torch.isfinite(trajectory.positions).flatten(1).all(1)
    if broken.any():
        raise RunError(
            f"{name}, {record.name}: the prediction is not finite from frame {int(broken.nonzero()[0])} on. "
            "Evaluate an earlier checkpoint, or train again with a smaller learning rate."
        )
    return trajectory


def _images(
    task: _Task,
    totals: _Totals,
    record: SequenceRecord,
    trajectories: Mapping[str, Trajectory],
    reference: Trajectory,
    pictures: PictureRecorder | None,
) -> Rows:
    """Image figures of every frame and view, and the image energy of the truth."""
    cameras = record.cameras_of(task.views)
    first = _draw(task, reference, range(1), cameras)
    parts: dict[str, dict[str, list[Tensor]]] = defaultdict(lambda: defaultdict(list))
    before: dict[str, Tensor] = {}
    for frames in _chunks(record, len(task.views)):
        recorded = record.frames(frames, task.views)
        target, alpha = composite(recorded)
        target, alpha = target.to(first.rgb), alpha.to(first.alpha)
        mask = alpha > 0
        totals.color += torch.cat((target[mask].sum(0, dtype=torch.float64), mask.sum()[None].double())).cpu()
        images = {
            name: totals.costs[name].draw(partial(_draw, task, t, frames, cameras), mask.shape[:2].numel())
            for name, t in trajectories.items()
        }
        if pictures is not None:
            pictures.add(recorded, images)
        if task.reference.name == STATIC:  # one frame, drawn once
            images[STATIC] = Rendered(first.rgb.expand_as(target), first.alpha.expand_as(alpha))
        else:
            images[task.reference.name] = _draw(task, reference, frames, cameras)
        largest = (next(iter(images.values())).rgb - target).norm(dim=-1).max()
        totals.max_l2 = max(totals.max_l2, float(largest))
        for name, shown in images.items():
            parts[name][IOU].append(metrics.mask_iou(shown.alpha, alpha))
            for metric in task.metrics:
                flat = (x.flatten(0, 1) for x in (shown.rgb, target, mask))
                parts[name][metric.key].append(metric.per_image(*flat).reshape(mask.shape[:2]))
        for name, rgb in {**{name: shown.rgb for name, shown in images.items()}, TRUTH: target}.items():
            parts[name][IMAGE_ENERGY].append(_energy(rgb, before.get(name)))
            before[name] = rgb[-1:]
    return {row: {m: torch.cat(v).cpu().numpy() for m, v in ms.items()} for row, ms in parts.items()}


def _draw(task: _Task, trajectory: Trajectory, frames: range, cameras: Cameras) -> Rendered:
    """Images of the foreground on black, with colours clamped to [0, 1] as in image files."""
    part = slice(frames.start, frames.stop)
    state = trajectory.positions[part], trajectory.deformation_gradients[part], trajectory.rotations[part]
    images = draw(task.renderer, task.look, *state, trajectory.unit_of_kernel, cameras)
    return Rendered(images.rgb.clamp(0, 1), images.alpha)


def _points(
    task: _Task, totals: _Totals, rows: Rows, trajectories: Mapping[str, Trajectory], truth: GroundTruth
) -> None:
    """Adds 3D errors and energies to the rows."""
    attached = task.attached
    assert attached is not None
    predicted = {
        name: t.carry(truth.rest.to(t.positions), attached, task.scene.means).to(truth.positions)
        for name, t in trajectories.items()
    }
    displacement = truth.positions - truth.rest
    for name, linear in task.linear.items():
        predicted[name] = truth.rest + linear.rollout(displacement[: linear.order], len(truth.positions) - 1)
    moving = {name: points for name, points in predicted.items() if name != task.reference.name}
    units = {name: [unit.cpu()[attached] for unit in found] for name, found in _told(task, "units").items() if found}
    totals.diagnosis.add(truth.positions, truth.rest, moving, units)
    diagonal = task.data.diagonal or float((truth.rest.amax(0) - truth.rest.amin(0)).norm())
    every = {**predicted, TRUTH: truth.positions}
    totals.bounces.add(every, diagonal)
    for name, points in every.items():
        row = rows.setdefault(name, {})
        if name != TRUTH:
            row[ERROR_3D] = metrics.point_error(points, truth.positions, diagonal).cpu().numpy()
            row[TRACK_ERROR] = metrics.track_error(points, truth.positions).cpu().numpy()
            row[CHAMFER] = metrics.chamfer(points, truth.positions).numpy()
        row[POINT_ENERGY] = np.concatenate(([np.nan], metrics.motion_energy(points).cpu().numpy()))


def _chunks(record: SequenceRecord, views: int) -> Iterator[range]:
    size = max(1, PIXELS_AT_ONCE // (views * record.cameras.width * record.cameras.height))
    for start in range(0, record.count, size):
        yield range(start, min(start + size, record.count))


def _energy(images: Float[Tensor, "F V H W 3"], before: Tensor | None) -> Float[Tensor, "F V"]:
    """Image energy of the step into every frame and view; NaN for the very first frame."""
    first = torch.full_like(images[:1], torch.nan) if before is None else before
    return torch.cat((first, images)).diff(dim=0).square().sum((2, 3, 4))


def _stack(results: list[Rows]) -> Rows:
    """Stacks sequences along a new first axis, with NaN for missing frames and unknown truth."""
    stacked: Rows = {}
    for row, metric in dict.fromkeys((row, m) for r in results for row, ms in r.items() for m in ms):
        arrays = [r.get(row, {}).get(metric) for r in results]
        shape = max(a.shape for a in arrays if a is not None)
        joined = np.full((len(results), *shape), np.nan)
        for target, array in zip(joined, arrays, strict=True):
            if array is not None:
                target[: len(array)] = array
        stacked.setdefault(row, {})[metric] = joined
    return stacked
