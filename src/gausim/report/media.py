"""Pictures of a report, as data URIs: error curves, space-time slices, image grids, cameras side by side, videos."""

from __future__ import annotations

import base64
import io
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from gausim.core import GausSimError
from gausim.io.video import write_video
from gausim.report.curves import ERROR_3D, POINT_ARRAYS, STATIC, ObjectCurves, load_curves
from gausim.report.diagnosis import diagnosis_plot, read_diagnosis
from gausim.report.figures import METHOD_COLORS, SEEN_SHADE, contact_frames
from gausim.report.frames import Timeline, brighten, label_bar, moving_line, space_time_slice, timeline_bar
from gausim.report.pictures import Pictures, load_pictures
from gausim.report.runs import RunRecord
from gausim.report.study import Group, Study

_DPI = 100
_BORDER = "#f0962a"
TRUTH = "ground truth"
# More predictions than these side by side are too small to see; the tables have them all.
MOST_METHODS, MOST_VIEWS = 5, 3
# The brightest percentile of the true foreground becomes this light; never more than so much gain.
_LIGHT, _MOST_GAIN = 230.0, 2.5
# Height of a panel of a video [pixels].
_PANEL = 168


@dataclass(frozen=True)
class Exhibit:
    """One picture or video: heading, how to read it, ``image`` or ``video``, and its data URI."""

    title: str
    caption: str
    kind: str
    uri: str


@dataclass(frozen=True, eq=False)
class Shown:
    """Pictures of one sequence: (name, frames over the background) with the truth first.

    Attributes:
        pictures: what they were made from (cameras, border of the seen frames).
        columns: names and (F, V, h, w, 3) frames, brightened.
        note: what was done to them, for captions.
    """

    pictures: Pictures
    columns: list[tuple[str, np.ndarray]]
    note: str


def object_figures(study: Study, name: str) -> tuple[list[Exhibit], list[str]]:
    """All pictures of one object, and what could not be shown and why."""
    figures: list[Exhibit] = []
    problems: list[str] = []
    curves = _curves(study, name, problems)
    if curves:
        figures.append(_error_curves(name, curves))
    figures += _motions(study, name)
    for shown in _shown(study, name, problems):
        figures += [_slices(shown), _grid(shown), _cameras(shown), _video(shown)]
    return figures, problems


def _motions(study: Study, name: str) -> list[Exhibit]:
    """Spectra and phase errors, of the first seed of every row, where the true motion is known."""
    named = []
    for group in study.groups:
        found = [d for _, entry in group.entries(name) if (d := read_diagnosis(entry)) and group.method in d.rows]
        named += [(group.label, found[0], group.method)] if found else []
    if not named:
        return []
    caption = (
        "First seed of each row. Left: power of the true and the predicted points over frequency. Right: how far the "
        "prediction is out of step, over the principal motions; unrelated motions have 104 degrees."
    )
    return [Exhibit(f"Spectrum and phase: {name}", caption, "image", _png(diagnosis_plot(named, title=name)))]


def _curves(study: Study, name: str, problems: list[str]) -> list[tuple[Group, list[ObjectCurves]]]:
    found = []
    for group in study.groups:
        seeds = []
        for run, _ in group.entries(name):
            try:
                seeds += [_checked(c) for c in load_curves(_file(run, "metrics.npz")) if c.facts.name == name]
            except (GausSimError, ValueError, TypeError, KeyError) as error:
                problems.append(f"{group.label}: {error}")
        if seeds:
            found.append((group, seeds))
    return found


def _file(run: RunRecord, name: str) -> Path:
    return run.path / "evaluation" / name


def _checked(curves: ObjectCurves) -> ObjectCurves:
    """The curves, if their arrays have the axes that plots need."""
    sequences, views = len(curves.facts.sequences), len(curves.facts.views)
    for row, metrics in curves.values.items():
        for metric, values in metrics.items():
            axes = (sequences, -1) if metric in POINT_ARRAYS else (sequences, -1, views)
            if values.ndim != len(axes) or any(a not in (-1, n) for a, n in zip(axes, values.shape, strict=True)):
                raise ValueError(f"metrics.npz: {row}/{metric} has shape {values.shape}, expected {axes}")
    return curves


def _error_curves(name: str, curves: Sequence[tuple[Group, list[ObjectCurves]]]) -> Exhibit:
    """Errors over time of all rows, mean over sequences and seeds; the seen frames are shaded."""
    first = curves[0][1][0]
    panels = [("l2", views) for views in ("train", "heldout") if first.view_indices(views)]
    if any(ERROR_3D in m for _, seeds in curves for c in seeds for m in c.values.values()):
        panels.insert(0, (ERROR_3D, "points"))
    figure = Figure(figsize=(5.4 * len(panels), 3.9), dpi=_DPI, layout="constrained")
    for axes, (metric, views) in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
        for color, (group, seeds) in zip(METHOD_COLORS * len(curves), curves, strict=False):
            _curve(axes, [(c, group.method) for c in seeds], metric, views, color, group.label)
        _curve(axes, [(first, STATIC)], metric, views, "#555555", STATIC)
        border = first.facts.first_unseen - 0.5
        axes.axvspan(0, border, color=SEEN_SHADE, linewidth=0, zorder=0)
        axes.axvline(border, color=_BORDER, linewidth=1.4)
        title = {"points": "3D error [% of diagonal]", "train": "l2 ×10⁻³, training cameras"}
        axes.set_title(title.get(views, "l2 ×10⁻³, cameras never trained on"), fontsize=9)
        axes.set(xlabel="frame", ylim=(0, None), xlim=(0, max(first.facts.frames) - 1))
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)), fontsize=8)
    caption = (
        "Mean over sequences and seeds, band: ± one standard deviation over both. Shaded: frames that training saw."
    )
    return Exhibit(f"Errors over time: {name}", caption, "image", _png(figure))


def _curve(
    axes: Axes, members: Sequence[tuple[ObjectCurves, str]], metric: str, views: str, color: str, label: str
) -> None:
    lines = []
    for curves, row in members:
        values = curves.values.get(row, {}).get(metric)
        if values is None:
            continue
        lines.append(values if views == "points" else values[:, :, curves.view_indices(views)].mean(-1))
    if not lines:
        return
    length = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, 0), (0, length - line.shape[1])), constant_values=np.nan) for line in lines]
    stacked = np.concatenate(padded) * (1.0 if metric == ERROR_3D else 1e3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames that no sequence has
        mean, std = np.nanmean(stacked, 0), np.nanstd(stacked, 0)
    static = label == STATIC
    axes.plot(mean, "--" if static else "-", color=color, label=label, linewidth=1.2 if static else 1.8)
    if not static:
        axes.fill_between(np.arange(length), mean - std, mean + std, color=color, alpha=0.13, linewidth=0)


def _shown(study: Study, name: str, problems: list[str]) -> Iterator[Shown]:
    """One set of pictures per sequence and cameras; runs that kept the same ones stand side by side."""
    sets: dict[tuple[object, ...], list[tuple[str, Pictures, np.ndarray]]] = {}
    for group in study.groups:
        for run, _ in group.entries(name)[:1]:
            if not _file(run, "pictures.npz").is_file():
                problems.append(
                    f"{group.label}: its evaluation kept no pictures (an earlier version did it). "
                    f"Call `gausim evaluate {run.path}` again."
                )
                continue
            try:
                kept = [p for p in load_pictures(_file(run, "pictures.npz")) if p.object == name]
            except GausSimError as error:
                problems.append(f"{group.label}: {error}")
                continue
            for p in kept:
                if group.method in p.predictions:
                    key = (p.sequence, p.views, p.truth.shape)
                    sets.setdefault(key, []).append((group.label, p, p.predictions[group.method]))
    for members in sets.values():
        if len(members) > MOST_METHODS:
            left = ", ".join(label for label, _, _ in members[MOST_METHODS:])
            problems.append(f"pictures show the first {MOST_METHODS} rows only; left out: {left}")
        yield _lit(members[:MOST_METHODS])


def _lit(members: Sequence[tuple[str, Pictures, np.ndarray]]) -> Shown:
    first = members[0][1]
    opaque = first.truth[first.truth[..., 3] > 128][:, :3]
    bright = float(np.percentile(opaque.max(-1), 95)) if len(opaque) else _LIGHT
    gain = round(min(_MOST_GAIN, max(1.0, _LIGHT / max(bright, 1.0))), 2)
    columns = [(TRUTH, first.truth), *((label, frames) for label, _, frames in members)]
    shown = [(label, brighten(first.over_background(frames), gain)) for label, frames in columns]
    behind = "over plain grey (the recording keeps no background)" if first.background is None else (
        "over the original background"
    )  # fmt: skip
    note = (
        f"{first.sequence}; composited {behind}, brightened {gain:g}×, made smaller: for the eye, no number uses this."
    )
    return Shown(first, shown, note)


def _slices(shown: Shown) -> Exhibit:
    """Space-time slices through the line that moves most, one row per method and column per camera."""
    pictures, views = shown.pictures, _some_views(shown.pictures)
    figure = Figure(figsize=(5.2 * len(views), 1.5 * len(shown.columns) + 0.6), dpi=_DPI, layout="constrained")
    grid = figure.subplots(len(shown.columns), len(views), squeeze=False)
    for column, view in enumerate(views):
        line = moving_line(shown.columns[0][1][:, view])
        for axes, (label, frames) in zip(grid[:, column], shown.columns, strict=True):
            axes.imshow(space_time_slice(frames[:, view], line), aspect="auto", interpolation="nearest")
            axes.axvline(pictures.first_unseen - 0.5, color=_BORDER, linewidth=1.4)
            axes.set(yticks=[], xlim=(-0.5, len(frames) - 0.5))
            axes.tick_params(labelsize=7, labelbottom=axes is grid[-1, column])
            if column == 0:
                axes.set_ylabel(_short(label), fontsize=8)
        grid[0, column].set_title(f"{_view_name(pictures, view)}: {line[0]} {line[1]}", fontsize=9)
        grid[-1, column].set_xlabel("frame (foreseen right of the line)", fontsize=8)
    return Exhibit(f"Space-time slices: {pictures.object}", shown.note, "image", _png(figure))


def _grid(shown: Shown) -> Exhibit:
    """Chosen frames in the first camera, one row per method."""
    pictures, view = shown.pictures, _some_views(shown.pictures)[0]
    frames = contact_frames(len(pictures.truth), pictures.first_unseen)
    rows = [(label, [images[f, view] for f in frames]) for label, images in shown.columns]
    heads = [(str(f), "#c2410c" if f >= pictures.first_unseen else "black") for f in frames]
    title = f"Frames: {pictures.object}, {_view_name(pictures, view)}"
    return Exhibit(title, f"Orange numbers: foreseen frames. {shown.note}", "image", _panels(rows, heads))


def _cameras(shown: Shown) -> Exhibit:
    """The last seen, a foreseen and the last frame in several cameras."""
    pictures, views = shown.pictures, _some_views(shown.pictures)
    last, border = len(pictures.truth) - 1, pictures.first_unseen
    chosen = sorted({min(border - 1, last), min((border + last) // 2, last), last})
    rows = [(label, [images[f, v] for f in chosen for v in views]) for label, images in shown.columns]
    heads = [(f"{_view_name(pictures, v)}, {f}", "#c2410c" if f >= border else "black") for f in chosen for v in views]
    title = f"Several cameras: {pictures.object}"
    return Exhibit(title, f"Camera and frame; orange: foreseen. {shown.note}", "image", _panels(rows, heads))


def _panels(rows: Sequence[tuple[str, list[np.ndarray]]], heads: Sequence[tuple[str, str]]) -> str:
    height, width = rows[0][1][0].shape[:2]
    size = (1.25 * len(heads), 1.25 * height / width * len(rows) + 0.3)
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    grid = figure.subplots(len(rows), len(heads), squeeze=False)
    for line, (label, images) in zip(grid, rows, strict=True):
        for axes, image in zip(line, images, strict=True):
            axes.set(xticks=[], yticks=[])
            axes.imshow(image)
        line[0].set_ylabel(_short(label), fontsize=8)
    for axes, (head, color) in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=7, color=color)
    return _png(figure)


def _video(shown: Shown) -> Exhibit:
    """All methods side by side in several cameras."""
    pictures, views = shown.pictures, _some_views(shown.pictures)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_video(path, _video_frames(shown, views), pictures.fps)
        uri = "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()
    names = ", ".join(_view_name(pictures, v) for v in views)
    return Exhibit(f"Video: {pictures.object}", f"Rows: {names}. {shown.note}", "video", uri)


def _video_frames(shown: Shown, views: Sequence[int]) -> Iterator[np.ndarray]:
    timeline = Timeline(len(shown.pictures.truth), shown.pictures.first_unseen)
    zoom = _PANEL / shown.columns[0][1].shape[2]
    for number in range(timeline.frames):
        columns = []
        for label, frames in shown.columns:
            panels = [
                cv2.resize(frames[number, v], None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC) for v in views
            ]
            columns.append(np.concatenate([label_bar(_short(label), panels[0].shape[1]), *panels]))
        picture = np.concatenate(columns, 1)
        yield np.concatenate((picture, timeline_bar(number, timeline, shown.pictures.sequence, picture.shape[1])))


def _some_views(pictures: Pictures) -> list[int]:
    """A few cameras: trained ones, and one that training never saw where there is one."""
    trained = [i for i, v in enumerate(pictures.views) if v not in pictures.heldout_views]
    heldout = [i for i, v in enumerate(pictures.views) if v in pictures.heldout_views]
    return [*trained[: MOST_VIEWS - bool(heldout)], *heldout[:1]]


def _view_name(pictures: Pictures, view: int) -> str:
    name = pictures.views[view]
    return f"{name} (held out)" if name in pictures.heldout_views else name


def _short(label: str, most: int = 22) -> str:
    return label if len(label) <= most else label[: most - 2] + ".."


def _png(figure: Figure) -> str:
    # A dollar sign in a name would start a formula.
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()
