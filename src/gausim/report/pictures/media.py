"""Pictures of a report, as data URIs: error curves, space-time slices, frames of several cameras, videos."""

from __future__ import annotations

import base64
import io
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from gausim.core import GausSimError
from gausim.io.video import SMALL, write_video
from gausim.report.gather.diagnosis import read_diagnosis
from gausim.report.gather.study import Group, Study
from gausim.report.pictures.figures import error_plot, literal, panels_plot, slices_plot
from gausim.report.pictures.frames import Timeline, brighten, label_bar, light_gain, timeline_bar
from gausim.report.pictures.motion import diagnosis_plot
from gausim.results.curves import ObjectCurves, load_curves
from gausim.results.pictures import Pictures, kept_pictures

TRUTH = "ground truth"
# Largest number of predictions and of views side by side; the tables have all.
MOST_METHODS, MOST_VIEWS = 5, 3
# Height of a panel of a video [pixels].
_PANEL = 168


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


def object_figures(study: Study, name: str) -> tuple[list[Exhibit], list[str]]:
    """All pictures of one object, and the reasons for missing ones."""
    figures: list[Exhibit] = []
    problems: list[str] = []
    curves = _curves(study, name, problems)
    if curves:
        figures.append(_error_curves(name, curves))
    figures += _motions(study, name)
    for shown in _shown(study, name, problems):
        figures += [_slices(shown), _frames(shown)]
        # The first screens have a video of each method; this one compares them.
        figures += [_video(shown)] if len(shown.columns) > 2 else []
    return figures, problems


def _motions(study: Study, name: str) -> list[Exhibit]:
    """Spectra and phase errors of the first seed of every row, if the true motion is known."""
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
    return [Exhibit(f"Spectrum and phase: {name}", caption, "image", _drawn(diagnosis_plot(named, title=name)))]


def _curves(study: Study, name: str, problems: list[str]) -> list[tuple[Group, list[ObjectCurves]]]:
    found = []
    for group in study.groups:
        seeds = []
        for run, _ in group.entries(name):
            try:
                seeds += [c for c in load_curves(run.path / "evaluation" / "metrics.npz") if c.facts.name == name]
            except GausSimError as error:
                problems.append(f"{group.label}: {error}")
        if seeds:
            found.append((group, seeds))
    return found


def _error_curves(name: str, curves: Sequence[tuple[Group, list[ObjectCurves]]]) -> Exhibit:
    """Errors over time of all rows, averaged over sequences and seeds; the seen frames are shaded."""
    rows = [(group.label, [(c, group.method) for c in seeds]) for group, seeds in curves]
    first = curves[0][1][0]
    figure = error_plot([*rows, (first.facts.reference, [(first, first.facts.reference)])])
    caption = (
        "Mean over sequences and seeds, band: ± one standard deviation over both. Shaded: frames that training saw."
    )
    return Exhibit(f"Errors over time: {name}", caption, "image", _drawn(figure))


def _shown(study: Study, name: str, problems: list[str]) -> Iterator[Shown]:
    """One set of pictures per sequence and cameras, with all runs that have them side by side."""
    sets: dict[tuple[object, ...], list[tuple[str, Pictures, np.ndarray]]] = {}
    for group in study.groups:
        for run, _ in group.entries(name)[:1]:
            try:
                kept = kept_pictures(run.path, name)
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
    gain = light_gain(first.truth)
    columns = [(TRUTH, first.truth), *((label, frames) for label, _, frames in members)]
    shown = [(label, brighten(first.over_background(frames), gain)) for label, frames in columns]
    behind = "the original background"
    if first.background is None:
        behind = "plain grey (the recording keeps no background)"
    made = f"composited over {behind}, brightened {gain:g}×, made smaller"
    note = f"{first.sequence}; {made}: for the eye, no number uses this."
    return Shown(first, shown, note)


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
    caption = f"Camera and frame; orange: foreseen. {shown.note}"
    return Exhibit(f"Frames: {pictures.object}", caption, "image", _drawn(panels_plot(rows, heads)))


def _video(shown: Shown) -> Exhibit:
    """All methods side by side in several cameras."""
    pictures, views = shown.pictures, _some_views(shown.pictures)
    uri = video_uri(_video_frames(shown, views), pictures.fps)
    names = ", ".join(_view_name(pictures, v) for v in views)
    return Exhibit(f"Side by side: {pictures.object}", f"Rows: {names}. {shown.note}", "video", uri)


def video_uri(frames: Iterable[np.ndarray], fps: float) -> str:
    """The MP4 of (H, W, 3) uint8 frames as a data URI."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_video(path, frames, fps, quality=SMALL)
        return "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()


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
    trained = [i for i, v in enumerate(pictures.views) if v not in pictures.heldout_views]
    heldout = [i for i, v in enumerate(pictures.views) if v in pictures.heldout_views]
    return [*trained[: MOST_VIEWS - bool(heldout)], *heldout[:1]]


def _view_name(pictures: Pictures, view: int) -> str:
    name = pictures.views[view]
    return f"{name} (held out)" if name in pictures.heldout_views else name


def _short(label: str, most: int = 22) -> str:
    return label if len(label) <= most else label[: most - 2] + ".."


def _drawn(figure: Figure) -> str:
    stream = io.BytesIO()
    literal(figure).savefig(stream, format="webp", pil_kwargs={"quality": 85})
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()
