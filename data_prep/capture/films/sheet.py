"""A picture that shows by eye whether films are synchronised: the same moments, one above the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from data_prep.common.photos import write_picture

MOMENTS, SIDE = 9, 160


def write_sheet(path: Path, thumbnails: Mapping[str, Sequence[np.ndarray]]) -> None:
    """Writes a PNG of small pictures (h, w, 3): a row per camera, frames in a row around the fastest motion."""
    cameras = list(thumbnails.values())
    motion = sum(np.abs(np.diff(np.stack(frames).astype(np.float32), axis=0)).mean((1, 2, 3)) for frames in cameras)
    count = len(cameras[0])
    first = int(np.clip(np.argmax(motion) + 1 - MOMENTS // 2, 0, max(0, count - MOMENTS))) if count > 1 else 0
    rows = [np.hstack([cv2.resize(f, (SIDE, SIDE)) for f in frames[first : first + MOMENTS]]) for frames in cameras]
    for row, name in zip(rows, thumbnails, strict=True):
        cv2.putText(row, f"{name}, frames from {first}", (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 60, 60), 1)
    write_picture(path, np.vstack(rows))
