"""Pictures of a report, as data URIs: videos, error curves, space-time slices, frames of several cameras."""

from __future__ import annotations

import base64
import io
import shlex
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from gausim.core import GausSimError, RunError
from gausim.io.video import SMALL, write_video
from gausim.pictures.figures import diagnosis_plot, error_plot, literal, panels_plot, slices_plot
from gausim.pictures.frames import (
    ERROR_RANGE,
    Timeline,
    brighten,
    error_colors,
    label_bar,
    light_gain,
    time_line,
    timeline_bar,
)
from gausim.report.runs import RunRecord
from gausim.report.study import Study
from gausim.results.curves import ObjectCurves, load_curves
from gausim.results.diagnosis import read_diagnosis
from gausim.results.pictures import Pictures, kept_pictures

TRUTH = "ground truth"
# Largest number of predictions and of views side by side; the tables have all.
MOST_METHODS, MOST_VIEWS = 5, 3
# Height of a panel of a video [pixels].
_PANEL = 168
# Largest width and height of a film's panel [pixels]; length below which it is shown at half speed [s].
_WIDEST, _HIGHEST, _SHORT = 352, 400, 4.0


@dataclass(frozen=True)
class Exhibit:
    """One picture or video: heading, caption, ``image`` or ``video``, and its data URI."""

    title: str
    caption: str
    kind: str
    uri: str


@dataclass(frozen=True, eq=False)
class Shown:
    """Pictures of one sequence, the truth first."""

    pictures: Pictures  # the source (cameras, first unseen frame)
    columns: list[tuple[str, np.ndarray]]  # names and (F, V, h, w, 3) frames over the background, brightened
    note: str  # note on their processing, for captions


@dataclass(frozen=True)
class Film:
    """A video of truth, prediction and error side by side: data URIs of the MP4 and of its poster image."""

    uri: str
    poster: str
    width: int  # [pixels]
    caption: str


def make_film(run: RunRecord, name: str, method: str) -> Film:
    """The video of an evaluated run and object, in the first held-out view, else in the first view.

    Raises:
        RunError: the evaluation has no pictures of this object and method, or they cannot be read.
    """
    found = next((item for item in kept_pictures(run.path, name) if method in item.predictions), None)
    if found is None:
        raise RunError(
            f"its evaluation kept no pictures of {name} predicted by {method}. Make them with `gausim evaluate "
            f"{shlex.quote(str(run.path))}`."
        )
    view = next((i for i, v in enumerate(found.views) if v in found.heldout_views), 0)
    gain, slow = light_gain(found.truth[:, view]), 2 if len(found.truth) < _SHORT * found.fps else 1
    frames = list(_film_frames(found, method, view, gain))
    poster = frames[min(found.first_unseen, len(frames) - 1)]
    uri = _video_uri(frames, found.fps / slow)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(poster, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
    caption = _film_caption(found, found.views[view], gain, slow)
    return Film(uri, _data_uri("image/jpeg", jpeg.tobytes()), poster.shape[1], caption)


def _film_frames(pictures: Pictures, method: str, view: int, gain: float) -> Iterator[np.ndarray]:
    height, width = pictures.truth.shape[2:4]
    zoom = min(_WIDEST / width, _HIGHEST / height)
    # The encoder requires even sizes.
    size = 2 * max(1, round(width * zoom / 2)), 2 * max(1, round(height * zoom / 2))
    both = pictures.truth, pictures.predictions[method]
    truth, predicted = (pictures.over_background(frames)[:, view] for frames in both)
    timeline = Timeline(len(truth), pictures.first_unseen)
    for number, (true, ours) in enumerate(zip(truth, predicted, strict=True)):
        panels = (brighten(true, gain), brighten(ours, gain), error_colors(true, ours))
        picture = np.concatenate([cv2.resize(p, size, interpolation=cv2.INTER_CUBIC) for p in panels], 1)
        yield np.concatenate((picture, time_line(number, timeline, picture.shape[1])))


def _film_caption(pictures: Pictures, view: str, gain: float, slow: int) -> str:
    kind = "never trained on" if view in pictures.heldout_views else "a training view; the evaluation has no other"
    speed = ", at half speed" if slow > 1 else ""
    bright = f", brightened {gain:g}×" if gain != 1 else ""
    return (
        f"{pictures.sequence} in {view} ({kind}){speed}{bright}. Error: distance of the colours, from 0 (black) to "
        f"{ERROR_RANGE:g} and more (brightest)."
    )


def object_figures(study: Study, name: str) -> tuple[list[Exhibit], list[str]]:
    """All pictures of one object, and the reasons for missing ones."""
    problems: list[str] = []
    figures = [*_error_curves(study, name, problems), *_motions(study, name)]
    for shown in _shown(study, name, problems):
        figures += [_slices(shown), _frames(shown)]
        # The first screens have a video of each method; this one compares them.
        figures += [_video(shown)] if len(shown.columns) > 2 else []
    return figures, problems


def _motions(study: Study, name: str) -> list[Exhibit]:
    """Spectra and phase errors of the first seed of every row, if the true motion is known."""
    named = []
    for group in study.groups:
        read = (read_diagnosis(info.diagnosis, info.splits["seen"][1]) for _, info in group.entries(name))
        found = [diagnosis for diagnosis in read if diagnosis is not None and group.method in diagnosis.rows]
        named += [(group.label, found[0], group.method)] if found else []
    if not named:
        return []
    caption = (
        "First seed of each row. Left: power of the true and the predicted points over frequency. Right: how far the "
        "prediction is out of step, over the principal motions; unrelated motions have 104 degrees."
    )
    return [Exhibit(f"Spectrum and phase: {name}", caption, "image", _drawn(diagnosis_plot(named, title=name)))]


def _error_curves(study: Study, name: str, problems: list[str]) -> list[Exhibit]:
    """Errors over time of all rows, averaged over sequences and seeds; the seen frames are shaded."""
    rows = []
    for group in study.groups:
        seeds: list[ObjectCurves] = []
        for run, _ in group.entries(name):
            try:
                seeds += [c for c in load_curves(run.path / "evaluation" / "metrics.npz") if c.facts.name == name]
            except GausSimError as error:
                problems.append(f"{group.label}: {error}")
        rows += [(group.label, [(curves, group.method) for curves in seeds])] if seeds else []
    if not rows:
        return []
    first = rows[0][1][0][0]
    figure = error_plot([*rows, (first.facts.reference, [(first, first.facts.reference)])])
    caption = (
        "Mean over sequences and seeds, band: ± one standard deviation over both. Shaded: frames that training saw."
    )
    return [Exhibit(f"Errors over time: {name}", caption, "image", _drawn(figure))]


def _shown(study: Study, name: str, problems: list[str]) -> Iterator[Shown]:
    """One set of pictures per sequence and cameras, with all runs that have them side by side."""
    sets: dict[tuple[object, ...], list[tuple[str, Pictures, np.ndarray]]] = defaultdict(list)
    for group in study.groups:
        for run, _ in group.entries(name)[:1]:
            try:
                kept = kept_pictures(run.path, name)
            except GausSimError as error:
                problems.append(f"{group.label}: {error}")
                continue
            for p in kept:
                if group.method in p.predictions:
                    sets[p.sequence, p.views, p.truth.shape].append((group.label, p, p.predictions[group.method]))
    for members in sets.values():
        if len(members) > MOST_METHODS:
            left = ", ".join(label for label, _, _ in members[MOST_METHODS:])
            problems.append(f"pictures show the first {MOST_METHODS} rows only; left out: {left}")
        yield _lit(members[:MOST_METHODS])


def _lit(members: Sequence[tuple[str, Pictures, np.ndarray]]) -> Shown:
    first = members[0][1]
    gain = light_gain(first.truth)
    columns = [(TRUTH, first.truth), *((label, frames) for label, _, frames in members)]
    shown = [(label, brighten(first.over_background(frames), gain)) for label, frames in columns]
    grey = "plain grey (the recording keeps no background)"
    behind = grey if first.background is None else "the original background"
    made = f"composited over {behind}, brightened {gain:g}×, made smaller"
    return Shown(first, shown, f"{first.sequence}; {made}: for the eye, no number uses this.")


def _slices(shown: Shown) -> Exhibit:
    """Space-time slices through the line with the most motion, one row per method and column per camera."""
    pictures = shown.pictures
    columns = [
        (_view_name(pictures, view), [(_short(label), frames[:, view]) for label, frames in shown.columns])
        for view in _some_views(pictures)
    ]
    figure, _ = slices_plot(columns, pictures.first_unseen)
    return Exhibit(f"Space-time slices: {pictures.object}", shown.note, "image", _drawn(figure))


def _frames(shown: Shown) -> Exhibit:
    """The last seen, an unseen and the last frame in several cameras, one row per method."""
    pictures = shown.pictures
    last, border = len(pictures.truth) - 1, pictures.first_unseen
    chosen = sorted({min(border - 1, last), min((border + last) // 2, last), last})
    places = [(f, v) for f in chosen for v in _some_views(pictures)]
    rows = [(_short(label), [images[place] for place in places]) for label, images in shown.columns]
    heads = [(f"{_view_name(pictures, v)}, {f}", f >= border) for f, v in places]
    caption = f"Camera and frame; orange: unseen frames. {shown.note}"
    return Exhibit(f"Frames: {pictures.object}", caption, "image", _drawn(panels_plot(rows, heads)))


def _video(shown: Shown) -> Exhibit:
    """All methods side by side in several cameras."""
    pictures, views = shown.pictures, _some_views(shown.pictures)
    uri = _video_uri(_video_frames(shown, views), pictures.fps)
    names = ", ".join(_view_name(pictures, v) for v in views)
    return Exhibit(f"Side by side: {pictures.object}", f"Rows: {names}. {shown.note}", "video", uri)


def _video_uri(frames: Iterable[np.ndarray], fps: float) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_video(path, frames, fps, quality=SMALL)
        return _data_uri("video/mp4", path.read_bytes())


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
    """A few training cameras, and a held-out one if there is any."""
    heldout = [i for i, v in enumerate(pictures.views) if v in pictures.heldout_views][:1]
    trained = [i for i, v in enumerate(pictures.views) if v not in pictures.heldout_views]
    return [*trained[: MOST_VIEWS - len(heldout)], *heldout]


def _view_name(pictures: Pictures, view: int) -> str:
    name = pictures.views[view]
    return f"{name} (held out)" if name in pictures.heldout_views else name


def _short(label: str, most: int = 22) -> str:
    return label if len(label) <= most else label[: most - 2] + ".."


def _drawn(figure: Figure) -> str:
    stream = io.BytesIO()
    literal(figure).savefig(stream, format="webp", pil_kwargs={"quality": 85})
    return _data_uri("image/webp", stream.getvalue())


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
