"""Comparison of images of truth and prediction: side-by-side frames, error colours, space-time slices."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

# Colour distance at the bright end of the error colours; the largest possible one is sqrt(3).
ERROR_RANGE = 0.5
PANEL_HEIGHT = 320
_BAR, _LINE = 24, 8
SEEN, UNSEEN = (120, 160, 200), (240, 150, 40)
_INK, _PAPER = (235, 235, 235), (24, 24, 24)
# Brightness to which the brightest percentile of the true foreground is raised, and the largest gain.
_LIGHT, _MOST_GAIN = 230.0, 2.5


@dataclass(frozen=True)
class Timeline:
    """Number of a video's frames, and the first unseen one."""

    frames: int
    first_unseen: int


def error_colors(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    """Heat map of the colour distance per pixel of (H, W, 3) uint8 images, black = 0, brightest = ERROR_RANGE."""
    distance = np.linalg.norm(truth.astype(np.float32) - prediction.astype(np.float32), axis=-1) / 255
    level = np.clip(distance / ERROR_RANGE * 255 + 0.5, 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def video_frame(
    truth: np.ndarray | None,
    prediction: np.ndarray,
    frame: int,
    timeline: Timeline,
    title: str,
    *,
    height: int = PANEL_HEIGHT,
) -> np.ndarray:
    """One frame of a comparison: ground truth | prediction | error, labels above, the time line below.

    Images are (H, W, 3) uint8, enlarged to ``height`` rows if smaller; ``truth`` is None beyond the recorded
    frames.
    """
    missing = np.full_like(prediction, _PAPER[0])
    error = missing if truth is None else error_colors(truth, prediction)
    panels = [missing if truth is None else truth, prediction, error]
    zoom = max(1.0, height / prediction.shape[0])
    if zoom > 1:
        panels = [cv2.resize(p, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC) for p in panels]
    labels = ["ground truth" if truth is not None else "no ground truth", "prediction", f"error 0..{ERROR_RANGE:g}"]
    labelled = [np.concatenate((label_bar(text, p.shape[1]), p)) for text, p in zip(labels, panels, strict=True)]
    picture = np.concatenate(labelled, axis=1)
    return np.concatenate((picture, timeline_bar(frame, timeline, title, picture.shape[1])))


def label_bar(text: str, width: int) -> np.ndarray:
    """A dark bar with a line of text."""
    bar = np.full((_BAR, width, 3), _PAPER, np.uint8)
    return cv2.putText(bar, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.48, _INK, 1, cv2.LINE_AA)


def timeline_bar(frame: int, timeline: Timeline, title: str, width: int) -> np.ndarray:
    """Title, number of the frame and time line, which is orange from the first unseen frame on."""
    unseen = frame >= timeline.first_unseen
    state = "UNSEEN" if unseen else "seen in training"
    bar = label_bar(f"{title}   frame {frame}/{timeline.frames - 1}   {state}", width)
    if unseen:
        bar[:, -_BAR:] = UNSEEN
    return np.concatenate((bar, time_line(frame, timeline, width)))


def time_line(frame: int, timeline: Timeline, width: int) -> np.ndarray:
    """The time line up to a frame, with a mark at the first unseen frame."""
    line = np.full((_LINE, width, 3), _PAPER, np.uint8)
    begin, now = (round(width * f / timeline.frames) for f in (timeline.first_unseen, frame + 1))
    line[:, : min(begin, now)] = SEEN
    line[:, begin:now] = UNSEEN
    line[:, min(begin, width - 1) :][:, :2] = _INK
    return line


def moving_line(frames: np.ndarray) -> tuple[str, int]:
    """The image line with the most motion per pixel in (F, H, W, 3) frames: ("column" | "row", index)."""
    moved = np.zeros(frames.shape[1:3])
    for before, after in zip(frames[:-1], frames[1:], strict=True):
        moved += np.square(after.astype(np.float32) - before.astype(np.float32)).sum(-1)
    columns, rows = moved.mean(0), moved.mean(1)
    if columns.max() >= rows.max():
        return "column", int(columns.argmax())
    return "row", int(rows.argmax())


def space_time_slice(frames: np.ndarray, line: tuple[str, int]) -> np.ndarray:
    """One image line of all (F, H, W, 3) frames side by side: (pixels of the line, F, 3), time to the right."""
    kind, index = line
    picked = frames[:, :, index] if kind == "column" else frames[:, index]
    return picked.swapaxes(0, 1)


def brighten(frames: np.ndarray, gain: float) -> np.ndarray:
    """uint8 frames times a gain, clipped at white; for display only."""
    if gain == 1:
        return frames
    table = np.clip(np.arange(256) * gain + 0.5, 0, 255).astype(np.uint8)
    return table[frames]


def light_gain(truth: np.ndarray) -> float:
    """Gain for display of the foreground of (..., 4) uint8 frames, RGB premultiplied with alpha."""
    opaque = truth[truth[..., 3] > 128][:, :3]
    bright = float(np.percentile(opaque.max(-1), 95)) if len(opaque) else _LIGHT
    return round(min(_MOST_GAIN, max(1.0, _LIGHT / max(bright, 1.0))), 2)
