"""Pictures to check masks by eye: overlays as a film, and a sheet of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from data_prep.capture.masks.clips import Clip, sampled
from data_prep.common.photos import read_picture, write_picture
from gausim.io.files import replacing

OUTLINE = (255, 40, 120)
# The foreground is drawn on a colour that objects rarely have.
GROUND = (90, 0, 140)
SIDE = 480
SHEET = 12


def overlay(rgb: np.ndarray, alpha: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Left the picture with the background dimmed and the mask's outline, right what was cut out; each of ``size``."""
    rgb, alpha = (cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in (rgb, alpha))
    weight = alpha[..., None].astype(np.float32) / 255
    left = rgb * (0.35 + 0.65 * weight)
    inside = (alpha > 127).astype(np.uint8)
    outline = cv2.dilate(inside, np.ones((3, 3), np.uint8)) != inside
    left[outline] = OUTLINE
    right = rgb * weight + np.array(GROUND, np.float32) * (1 - weight)
    return np.ascontiguousarray(np.concatenate([left, right], axis=1).astype(np.uint8))


def write_overlays(clip: Clip, masks: Sequence[Path], folder: Path, *, fps: float) -> None:
    """Writes ``NAME.mp4`` of all pictures and ``NAME.jpg`` of some."""
    from gausim.io.video import write_video

    height, width = clip.rgb(0).shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = max(2, round(width * scale)), max(2, round(height * scale))

    def frames(indices: Sequence[int]) -> Iterator[np.ndarray]:
        for i in indices:
            yield overlay(clip.rgb(i), read_picture(masks[i])[..., 3], size)

    with replacing(folder / f"{clip.flat}.mp4", typed=True) as temporary:
        write_video(temporary, frames(range(len(clip))), fps)
    chosen = list(frames(sampled(len(clip), SHEET)))
    columns = 3 if len(chosen) > 4 else 2
    blank = np.zeros_like(chosen[0])
    chosen += [blank] * (-len(chosen) % columns)
    rows = [np.concatenate(chosen[i : i + columns], axis=1) for i in range(0, len(chosen), columns)]
    write_picture(folder / f"{clip.flat}.jpg", np.concatenate(rows))
