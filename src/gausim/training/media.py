"""Media of training: videos, pictures and tables, as files of the run."""

from __future__ import annotations

import csv
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from gausim.io.video import write_video
from gausim.pictures.frames import Timeline, error_colors, label_bar, moving_line, space_time_slice, video_frame

FOLDER = "panels"
# Largest number of rows of images, which are shrunk to it, and smallest of videos, which are enlarged [pixels].
MOST_ROWS, LEAST_ROWS = 256, 128
# Smallest width of space-time slices: one pixel per frame is too narrow [pixels].
_SLICE_WIDTH = 384
_STEP = re.compile(r"step_(\d+)")


@dataclass(frozen=True)
class Media:
    """The media of one optimiser step: a folder with four files per sequence and a table of the objects."""

    folder: Path
    step: int

    @property
    def names(self) -> list[str]:
        """The sequences, each as OBJECT_SEQUENCE."""
        return sorted(path.stem for path in self.folder.glob("*.mp4"))

    def video(self, name: str) -> Path:
        """Ground truth | prediction | error."""
        return self.folder / f"{name}.mp4"

    def pictures(self, name: str) -> dict[str, Path]:
        """``frames`` (chosen frames side by side) and ``slice`` (space-time)."""
        return {kind: self.folder / f"{name}.{kind}.png" for kind in ("frames", "slice")}

    def errors(self, name: str) -> tuple[list[str], list[list[str]]]:
        """Columns and rows of the errors by frame."""
        return _read_table(self.folder / f"{name}.errors.csv")

    def objects(self) -> tuple[list[str], list[list[str]]]:
        """Columns and rows of the table with a line per object."""
        return _read_table(self.folder / "objects.csv")


@dataclass(frozen=True, eq=False)
class Clip:
    """One sequence in one camera: truth and prediction over black, and errors by frame in the units of tables.

    ``name`` is for files, ``title`` for display.
    """

    name: str
    title: str
    fps: float
    truth: UInt8[np.ndarray, "F H W 3"]
    prediction: UInt8[np.ndarray, "F H W 3"]
    errors: dict[str, Float[np.ndarray, " F"]]


def write_media(run: Path, step: int, clips: Sequence[Clip], columns: list[str], rows: list[list[str]]) -> Media:
    """Writes the media of a step to the run directory, atomically; ``columns`` and ``rows`` are by object."""
    media = Media(run / FOLDER / f"step_{step:06d}", step)
    temporary = media.folder.with_name(f".{media.folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    for clip in clips:
        _write_clip(temporary, clip)
    _write_table(temporary / "objects.csv", columns, rows)
    shutil.rmtree(media.folder, ignore_errors=True)
    os.replace(temporary, media.folder)
    return media


def media_of(run: Path) -> list[Media]:
    """All media of a run, in the order of their steps."""
    found = [(_STEP.fullmatch(path.name), path) for path in (run / FOLDER).glob("step_*")]
    return sorted((Media(path, int(m[1])) for m, path in found if m), key=lambda media: media.step)


def forget_media(run: Path, after: int) -> None:
    """Removes media of later steps than ``after``, and incomplete ones."""
    for media in media_of(run):
        if media.step > after:
            shutil.rmtree(media.folder)
    for folder in (run / FOLDER).glob(".step_*.tmp"):
        shutil.rmtree(folder)


def safe_name(*parts: str) -> str:
    """A file name from names with arbitrary characters."""
    return re.sub(r"[^\w.-]+", "_", "_".join(parts))


def _write_clip(folder: Path, clip: Clip) -> None:
    truth, prediction = _shrunk(clip.truth), _shrunk(clip.prediction)
    timeline = Timeline(len(truth), len(truth))
    pairs = enumerate(zip(truth, prediction, strict=True))
    frames = (video_frame(t, p, i, timeline, clip.title, height=LEAST_ROWS) for i, (t, p) in pairs)
    write_video(folder / f"{clip.name}.mp4", frames, clip.fps)
    Image.fromarray(frame_panel(truth, prediction)).save(folder / f"{clip.name}.frames.png")
    Image.fromarray(slice_panel(truth, prediction)).save(folder / f"{clip.name}.slice.png")
    values = [["" if np.isnan(v) else f"{v:.6g}" for v in series] for series in clip.errors.values()]
    rows = [[str(i), *row] for i, row in enumerate(zip(*values, strict=True))]
    _write_table(folder / f"{clip.name}.errors.csv", ["frame", *clip.errors], rows)


def _shrunk(frames: UInt8[np.ndarray, "F H W 3"]) -> UInt8[np.ndarray, "F h w 3"]:
    factor = MOST_ROWS / frames.shape[1]
    if factor >= 1:
        return frames
    size = max(1, round(frames.shape[2] * factor)), MOST_ROWS
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def frame_panel(
    truth: UInt8[np.ndarray, "F H W 3"], prediction: UInt8[np.ndarray, "F H W 3"]
) -> UInt8[np.ndarray, "R C 3"]:
    """Three rows (ground truth, prediction, error colours) of six evenly spaced frames, first and last included."""
    chosen = sorted({round(i * (len(truth) - 1) / 5) for i in range(6)})
    rows = truth[chosen], prediction[chosen], [error_colors(truth[i], prediction[i]) for i in chosen]
    padded = [[np.pad(image, ((0, 2), (0, 2), (0, 0)), constant_values=64) for image in row] for row in rows]
    return np.concatenate([np.concatenate(row, 1) for row in padded])


def slice_panel(
    truth: UInt8[np.ndarray, "F H W 3"], prediction: UInt8[np.ndarray, "F H W 3"]
) -> UInt8[np.ndarray, "R C 3"]:
    """Space-time slices of truth, prediction and error along the true motion's strongest line, time to the right."""
    line = moving_line(truth)
    first, second = space_time_slice(truth, line), space_time_slice(prediction, line)
    named = {f"truth, {line[0]} {line[1]}": first, "prediction": second, "error": error_colors(first, second)}
    parts = []
    for name, image in named.items():
        wide = np.repeat(image, -(-_SLICE_WIDTH // image.shape[1]), axis=1)
        tall = np.repeat(wide, max(1, LEAST_ROWS // len(wide)), axis=0)
        parts += [label_bar(name, tall.shape[1]), tall]
    return np.concatenate(parts)


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def _read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(newline="") as file:
        columns, *rows = csv.reader(file)
    return columns, rows
