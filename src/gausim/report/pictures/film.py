"""Video on the first screen of a report: truth, prediction and error in a held-out view."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from gausim.core import RunError
from gausim.report.gather.runs import RunRecord
from gausim.report.pictures.frames import ERROR_RANGE, Timeline, brighten, error_colors, light_gain, time_line
from gausim.report.pictures.media import video_uri
from gausim.results.pictures import Pictures, kept_pictures

# Largest width and height of a panel [pixels]; length below which a video is shown at half speed [s].
_WIDEST, _HIGHEST, _SHORT = 352, 400, 4.0


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
    frames = list(_frames(found, method, view, gain))
    poster = frames[min(found.first_unseen, len(frames) - 1)]
    uri = video_uri(frames, found.fps / slow)
    return Film(uri, _jpeg(poster), poster.shape[1], _caption(found, found.views[view], gain, slow))


def _frames(pictures: Pictures, method: str, view: int, gain: float) -> Iterator[np.ndarray]:
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


def _caption(pictures: Pictures, view: str, gain: float, slow: int) -> str:
    kind = "never trained on" if view in pictures.heldout_views else "a training view; the evaluation has no other"
    speed = ", at half speed" if slow > 1 else ""
    bright = f", brightened {gain:g}×" if gain != 1 else ""
    return (
        f"{pictures.sequence} in {view} ({kind}){speed}{bright}. Error: distance of the colours, from 0 (black) to "
        f"{ERROR_RANGE:g} and more (brightest)."
    )


def _jpeg(picture: np.ndarray) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
