"""Comparison of films of truth and prediction: videos side by side, sheets of single frames, error colours."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

# Colour distance at the bright end of the error colours; the largest possible one is sqrt(3).
ERROR_RANGE = 0.5
PANEL_HEIGHT, SHEET_HEIGHT = 320, 160  # least height of the images in videos and sheets
_BAR, _LINE = 24, 8
SEEN, UNSEEN = (120, 160, 200), (240, 150, 40)
# Films: (F, H, W, 3) uint8, or a list of frames.
Frames = Sequence[np.ndarray] | np.ndarray
_INK, _PAPER = (235, 235, 235), (24, 24, 24)


def error_colors(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    """Heat map of the colour distance per pixel of (H, W, 3) uint8 images, black = 0, brightest = ERROR_RANGE."""
    distance = np.linalg.norm(truth.astype(np.float32) - prediction.astype(np.float32), axis=-1) / 255
    level = np.clip(distance / ERROR_RANGE * 255 + 0.5, 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def comparison(
    truth: Frames, prediction: Frames, title: str, first_unseen: int, *, height: int = PANEL_HEIGHT
) -> Iterator[np.ndarray]:
    """Frames of a video: ground truth | prediction | error, labels above, the time line below.

    Images are (H, W, 3) uint8, enlarged to ``height`` rows if smaller; the truth may have fewer than the prediction.
    """
    for frame, image in enumerate(prediction):
        known = frame < len(truth)
        labels = ["ground truth" if known else "no ground truth", "prediction", f"error 0..{ERROR_RANGE:g}"]
        panels = _panels(truth[frame] if known else None, image, height)
        labelled = [np.concatenate((label_bar(text, p.shape[1]), p)) for text, p in zip(labels, panels, strict=True)]
        picture = np.concatenate(labelled, axis=1)
        yield np.concatenate((picture, _timeline(frame, len(prediction), first_unseen, title, picture.shape[1])))


def contact_sheet(truth: Frames, prediction: Frames, first_unseen: int, *, height: int = SHEET_HEIGHT) -> np.ndarray:
    """One picture of about eight frames: truth, prediction and error below each other, unseen ones marked orange.

    They are the first, the last seen, the first unseen, the last, and evenly spaced ones between; images are those of
    :func:`comparison`.
    """
    last = len(prediction) - 1
    edges = {0, min(first_unseen - 1, last), min(first_unseen, last), last}
    even = np.linspace(0, last, 8).round().astype(int).tolist()
    columns = []
    for frame in sorted(edges | {f for f in even if min(abs(f - e) for e in edges) > 2}):
        panels = _panels(truth[frame] if frame < len(truth) else None, prediction[frame], height)
        bar = label_bar(str(frame), panels[0].shape[1])
        if frame >= first_unseen:
            bar[-4:] = UNSEEN
        columns.append(np.concatenate((bar, *panels)))
    return np.concatenate(columns, axis=1)


def shrunk(frames: np.ndarray, rows: int) -> np.ndarray:
    """(F, H, W, 3) frames, shrunk to ``rows`` rows if they have more."""
    if frames.shape[1] <= rows:
        return frames
    size = max(1, round(frames.shape[2] * rows / frames.shape[1])), rows
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def _panels(truth: np.ndarray | None, prediction: np.ndarray, height: int) -> list[np.ndarray]:
    """Truth, prediction and error of one frame, enlarged to ``height`` rows if smaller."""
    missing = np.full_like(prediction, _PAPER[0])
    error = missing if truth is None else error_colors(truth, prediction)
    panels = [missing if truth is None else truth, prediction, error]
    zoom = height / prediction.shape[0]
    if zoom <= 1:
        return panels
    return [cv2.resize(p, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC) for p in panels]


def label_bar(text: str, width: int) -> np.ndarray:
    """A dark bar with a line of text."""
    bar = np.full((_BAR, width, 3), _PAPER, np.uint8)
    return cv2.putText(bar, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.48, _INK, 1, cv2.LINE_AA)


def _timeline(frame: int, frames: int, first_unseen: int, title: str, width: int) -> np.ndarray:
    """Title, number of the frame and time line, which is orange from the first unseen frame on."""
    unseen = frame >= first_unseen
    state = "UNSEEN" if unseen else "seen in training"
    bar = label_bar(f"{title}   frame {frame}/{frames - 1}   {state}", width)
    line = np.full((_LINE, width, 3), _PAPER, np.uint8)
    begin, now = (round(width * f / frames) for f in (first_unseen, frame + 1))
    line[:, : min(begin, now)] = SEEN
    line[:, begin:now] = UNSEEN
    line[:, min(begin, width - 1) :][:, :2] = _INK
    if unseen:
        bar[:, -_BAR:] = UNSEEN
    return np.concatenate((bar, line))


def brighten(frames: np.ndarray, gain: float) -> np.ndarray:
    """uint8 frames times a gain, clipped at white; for display only."""
    if gain == 1:
        return frames
    table = np.clip(np.arange(256) * gain + 0.5, 0, 255).astype(np.uint8)
    return table[frames]
