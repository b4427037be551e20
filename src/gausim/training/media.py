"""Media of training: a video and a picture of every shown sequence, as files of the run."""

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gausim.io.video import write_video
from gausim.pictures.frames import comparison, contact_sheet, shrunk

FOLDER = "panels"
# Largest number of rows of images, which are shrunk to it, and smallest of videos, which are enlarged [pixels].
MOST_ROWS, LEAST_ROWS = 256, 128
_STEP = re.compile(r"step_(\d+)")


@dataclass(frozen=True, eq=False)
class Clip:
    """One sequence in one camera, over black; ``name`` is for files, ``title`` for display."""

    name: str
    title: str
    fps: float
    truth: UInt8[np.ndarray, "F H W 3"]
    prediction: UInt8[np.ndarray, "F H W 3"]


def write_media(run: Path, step: int, clips: Sequence[Clip]) -> Path:
    """Writes ``NAME.mp4`` and ``NAME.png`` of every clip to a folder of the run, atomically; returns the folder."""
    folder = run / FOLDER / f"step_{step:06d}"
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    for clip in clips:
        truth, prediction = shrunk(clip.truth, MOST_ROWS), shrunk(clip.prediction, MOST_ROWS)
        frames = comparison(truth, prediction, clip.title, len(truth), height=LEAST_ROWS)
        write_video(temporary / f"{clip.name}.mp4", frames, clip.fps)
        sheet = contact_sheet(truth, prediction, len(truth), height=LEAST_ROWS)
        Image.fromarray(sheet).save(temporary / f"{clip.name}.png")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(temporary, folder)
    return folder


def forget_media(run: Path, after: int) -> None:
    """Removes media of later steps than ``after``, and incomplete ones."""
    for folder in (run / FOLDER).glob("step_*"):
        if (found := _STEP.fullmatch(folder.name)) and int(found[1]) > after:
            shutil.rmtree(folder)
    for folder in (run / FOLDER).glob(".step_*.tmp"):
        shutil.rmtree(folder)


def safe_name(*parts: str) -> str:
    """A file name from names with arbitrary characters."""
    return re.sub(r"[^\w.-]+", "_", "_".join(parts))
