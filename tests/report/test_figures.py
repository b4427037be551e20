from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gausim.pictures.figures import picture_grid
from gausim.pictures.frames import comparison, contact_sheet, shrunk


def swinging(frames: int = 12, height: int = 20, width: int = 30) -> np.ndarray:
    """A bright spot that goes up and down in column 17."""
    images = np.zeros((frames, height, width, 3), np.uint8)
    for f in range(frames):
        images[f, 4 + f % 7, 17] = 250
    return images


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


def test_video_frames_have_one_size_and_mark_what_is_foreseen():
    images = swinging()
    frames = list(comparison(images[:8], images, "seq", 5))
    seen, foreseen, beyond = frames[4], frames[5], frames[11]
    assert seen.shape == foreseen.shape == beyond.shape and seen.dtype == np.uint8
    orange = (240, 150, 40)
    assert not (seen == orange).all(-1).any()
    assert (foreseen == orange).all(-1).sum() < (beyond == orange).all(-1).sum()


def test_sheets_show_truth_prediction_and_error_of_some_frames(tmp_path):
    truth = swinging()
    sheet = contact_sheet(truth[:8], np.roll(truth, 2, axis=0), 5)
    bar, (rows, columns) = 24, (160, 240)
    assert sheet.shape == (bar + 3 * rows, 5 * columns, 3)  # frames 0, 2, 4, 5, 8 or 9, 11
    assert (sheet[bar - 1, :, 0] == 240).tolist().count(True) == 3 * columns
    assert not sheet[bar:, -columns:][:rows].std() and sheet[bar + rows : bar + 2 * rows, -columns:].std()
    picture_grid(list(truth[:3]), ["a", "b", "c"], tmp_path / "grid.png", title="t", columns=2)
    assert read(tmp_path / "grid.png").max() == 255


def test_frames_are_only_made_smaller():
    images = swinging()
    assert shrunk(images, 20) is images and shrunk(images, 10).shape == (12, 10, 15, 3)
