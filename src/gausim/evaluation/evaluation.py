"""Evaluation of predictions of an object against its videos and, where known, its true 3D motion.

It needs no run: any callable that returns a :class:`Trajectory` of a sequence can be evaluated beside the references
(a prediction without dynamics, linear AR(p) on the true states). Frames are processed in chunks; per-frame figures are
kept.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
from gausim.evaluation.film import Film
from gausim.evaluation.references import Bounces, Reference
from gausim.io.files import write_durably
from gausim.metrics.lpips import NO_WEIGHTS, SMALLEST, TOO_SMALL, weights_path
from gausim.render.draw import SceneAppearance, draw
from gausim.report.render import evaluation_page
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
    save_curves,
)
from gausim.results.summary import entries_of, frame_splits, metrics_of
from gausim.results.table import NO_FORESIGHT, SCHEMA, STATIC, ObjectInfo, Results, save_results
from gausim.runs.cost import CostMeter
from gausim.runs.provenance import code_provenance, data_provenance
from gausim.training.supervision.points import attach_points

# Predicts every frame of a sequence (count frames, frame 0 first) for all kernels of the scene. Its optional attributes
# ``levels`` (plain data: counts, predicted, predictions, kernels) and ``footnotes`` (extrapolates, notes) are stored in
# the summary.
Predict = Callable[[SequenceRecord], Trajectory]
Rows = dict[str, dict[str, np.ndarray]]

# Modes of the linear references: few for robustness, more for finer motion. Frames that the last one remembers.
AR_MODES, AR_MEMORY = (8, 24), 4
MASK_IOU = ImageMetricInfo(IOU, "mask IoU", 1.0, "", higher_is_better=True)
# Pixels that are rendered and compared at once: about 100 MB of float images and their filters.
PIXELS_AT_ONCE = 1 << 20


def default_metrics(side: int = SMALLEST) -> list[metrics.ImageMetric]:
    """The image metrics of tables for images of ``side`` pixels, with LPIPS where it is available."""
    found = [metrics.L2(), metrics.ForegroundL2(), metrics.PSNR(), metrics.ForegroundPSNR(), metrics.SSIM()]
    return found if absent_metrics(side) else [*found, metrics.LPIPS()]


def absent_metrics(side: int) -> dict[str, str]:
    """Reason by key why LPIPS cannot be computed on images of ``side`` pixels; empty where it can."""
    reason = TOO_SMALL if side < SMALLEST else "" if weights_path().is_file() else NO_WEIGHTS
    return {metrics.LPIPS.key: reason} if reason else {}


@dataclass(eq=False)
class _Task:
    """What is measured of an object, and with what; and quantities over all sequences."""

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
    film: Film | None  # of the first sequence
    costs: dict[str, CostMeter]
    bounces: Bounces
    # sum of the true foreground's colours, and its pixels
    color: Tensor = field(default_factory=lambda: torch.zeros(4, dtype=torch.float64))
    max_l2: float = 0.0


def evaluate_object(
    data: ObjectData,
    scene: GaussianScene,
    methods: Mapping[str, Predict],
    renderer: Renderer,
    *,
    sequences: Sequence[str] | None = None,
    views: Sequence[str] | None = None,
    advance: Callable[[str], None] | None = None,
    films: Path | None = None,
) -> ObjectCurves:
    """Per-frame figures of every method (a prediction by its row) and reference on every sequence of an object.

    The rest scene has all kernels of the trajectories. Sequences and views are all, unless named;
    ``advance`` is called with a sequence's name when it is done. ``films`` is a folder for ``film_OBJECT.mp4`` of the
    first method on the first sequence.

    Raises:
        DataError: an unknown sequence, or broken data.
        RunError: a prediction has a wrong number of frames or kernels, or is not finite.
    """
    records = _chosen(data, sequences)  # before the task, which reads the true motion of all
    side = min(side for r in data.sequences for side in (r.cameras.width, r.cameras.height))
    reference, points = Reference(data, scene), data.rest_points
    chosen = data.views if views is None else views
    train, heldout = ([v for v in chosen if (v in data.train_views) == is_train] for is_train in (True, False))
    task = _Task(
        data, scene, methods, renderer, train + heldout, default_metrics(side), reference,
        SceneAppearance.of(scene, scene.foreground), None if points is None else attach_points(scene, points),
        _linear_references(data) if reference.name == STATIC else {},
        None if films is None else Film(data, records[0].name, train + heldout),
        {name: CostMeter() for name in methods}, Bounces(data),
    )  # fmt: skip
    results = list[Rows]()
    for record in records:
        # A separate record, so that its decoded frames are freed with it.
        results.append(_sequence(task, data.record(record.name), is_first=record is records[0]))
        if advance is not None:
            advance(record.name)
    r, g, b = (task.color[:3] / task.color[3].clamp_min(1)).tolist()
    told = {name: getattr(predict, "footnotes", None) or {} for name, predict in methods.items()}
    info = ObjectInfo(
        splits=frame_splits(max(record.count for record in records), data.train_frames.stop),
        reference=reference.name,
        methods=list(methods),
        sequences=[record.name for record in records],
        frames=[record.count for record in records],
        fps=data.fps,
        train_views=train,
        heldout_views=heldout,
        mean_color=(r, g, b),
        max_l2=task.max_l2,
        sources=data_provenance(data),
        absent=absent_metrics(side),
        notes={
            name: [NO_FORESIGHT] * (own.get("extrapolates") is False) + list(own.get("notes", []))
            for name, own in told.items()
        },
        film="" if task.film is None or films is None else task.film.write(films / f"film_{data.name}.mp4"),
    )
    shown = [ImageMetricInfo(m.key, m.label, m.scale, m.unit, bool(m.higher_is_better)) for m in task.metrics]
    costs = {
        name: {**meter.summary(), "levels": getattr(methods[name], "levels", None), "fit": told[name].get("fit")}
        for name, meter in task.costs.items()
    }
    return ObjectCurves(data.name, info, _stack(results), (*shown, MASK_IOU), costs, task.bounces.summary())


def write_evaluation(folder: Path, objects: list[ObjectCurves], run: dict[str, Any]) -> Results:
    """Writes metrics.json, metrics.npz and table.md to ``folder``; returns the content of metrics.json.

    ``run`` is what was evaluated; its ``seed`` is that of the methods' entries.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_curves(folder / "metrics.npz", objects)
    results = results_of(objects, run)
    save_results(folder / "metrics.json", results)
    write_durably(folder / "table.md", evaluation_page(results).encode())
    return results


def results_of(objects: Sequence[ObjectCurves], run: dict[str, Any]) -> Results:
    """The long table of evaluated objects."""
    table = [entry for curves in objects for entry in entries_of(curves, run.get("seed"))]
    infos = {curves.name: curves.info for curves in objects}
    known = code_provenance()
    return Results(SCHEMA, run=run, provenance=known, objects=infos, metrics=metrics_of(objects), table=table)


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
def _sequence(task: _Task, record: SequenceRecord, *, is_first: bool) -> Rows:
    """Figures of one sequence, (F, V) and (F,) per row and metric; the frames of the first are filmed."""
    trajectories = {}
    for name, predict in task.methods.items():
        made = task.costs[name].predict(partial(predict, record), record.count - 1)
        trajectories[name] = _checked(task, name, record, made)
    truth = task.data.ground_truth(record)
    reference = task.reference.trajectory(record, truth)
    device = next((made.positions.device for made in trajectories.values()), reference.positions.device)
    rows = _images(task, record, trajectories, reference.to(device), task.film if is_first else None)
    if truth is not None:
        moved = {name: trajectory.to("cpu") for name, trajectory in trajectories.items()}
        _points(task, rows, {**moved, task.reference.name: reference}, truth)
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
    record: SequenceRecord,
    trajectories: Mapping[str, Trajectory],
    reference: Trajectory,
    film: Film | None,
) -> Rows:
    """Image figures of every frame and view, and the image energy of the truth."""
    cameras = record.cameras_of(task.views)
    first = _draw(task, reference, range(1), cameras)
    parts: dict[str, dict[str, list[Tensor]]] = defaultdict(lambda: defaultdict(list))
    before: dict[str, Tensor] = {}
    for frames in _chunks(record, len(task.views)):
        target, alpha = composite(record.frames(frames, task.views))
        target, alpha = target.to(first.rgb), alpha.to(first.alpha)
        mask = alpha > 0
        task.color += torch.cat((target[mask].sum(0, dtype=torch.float64), mask.sum()[None].double())).cpu()
        images = {
            name: task.costs[name].draw(partial(_draw, task, t, frames, cameras), mask.shape[:2].numel())
            for name, t in trajectories.items()
        }
        if film is not None:
            film.add(target, next(iter(images.values())).rgb)
        if task.reference.name == STATIC:  # one frame, drawn once
            images[STATIC] = Rendered(first.rgb.expand_as(target), first.alpha.expand_as(alpha))
        else:
            images[task.reference.name] = _draw(task, reference, frames, cameras)
        largest = (next(iter(images.values())).rgb - target).norm(dim=-1).max()
        task.max_l2 = max(task.max_l2, float(largest))
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


def _points(task: _Task, rows: Rows, trajectories: Mapping[str, Trajectory], truth: GroundTruth) -> None:
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
    diagonal = task.data.diagonal or float((truth.rest.amax(0) - truth.rest.amin(0)).norm())
    every = {**predicted, TRUTH: truth.positions}
    task.bounces.add(every, diagonal)
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
