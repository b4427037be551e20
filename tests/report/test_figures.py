from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gausim.pictures.figures import contact_sheet, picture_grid, slice_figure
from gausim.pictures.frames import Timeline, moving_line, space_time_slice, video_frame


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


def test_the_moving_line_is_found_and_cut():
    images = swinging()
    assert moving_line(images) == ("column", 17)
    assert moving_line(images.swapaxes(1, 2)) == ("row", 17)
    cut = space_time_slice(images, ("column", 17))
    assert cut.shape == (20, 12, 3)
    assert [int(cut[:, f, 0].argmax()) for f in range(12)] == [4 + f % 7 for f in range(12)]
    assert np.array_equal(space_time_slice(images.swapaxes(1, 2), ("row", 17)), cut)


def test_video_frames_have_one_size_and_mark_what_is_unseen():
    images, timeline = swinging(), Timeline(12, 5)
    seen = video_frame(images[4], images[4], 4, timeline, "seq")
    unseen = video_frame(images[5], images[5], 5, timeline, "seq")
    beyond = video_frame(None, images[5], 11, timeline, "seq")
    assert seen.shape == unseen.shape == beyond.shape and seen.dtype == np.uint8
    orange = (240, 150, 40)
    assert not (seen == orange).all(-1).any()
    assert (unseen == orange).all(-1).sum() < (beyond == orange).all(-1).sum()


def test_slices_and_sheets_show_truth_and_prediction(tmp_path):
    truth = swinging()
    late = np.roll(truth, 2, axis=0)
    assert slice_figure(truth, late, tmp_path / "both.png", title="t", first_unseen=5) == ("column", 17)
    assert slice_figure(None, truth, tmp_path / "one.png", title="t", first_unseen=5) == ("column", 17)
    assert read(tmp_path / "both.png").shape[0] > 1.5 * read(tmp_path / "one.png").shape[0]
    contact_sheet(truth[:8], late, tmp_path / "sheet.png", title="t", first_unseen=5)
    contact_sheet(None, late, tmp_path / "alone.png", title="t", first_unseen=5)
    assert read(tmp_path / "sheet.png").shape[0] > 1.5 * read(tmp_path / "alone.png").shape[0]
    picture_grid(list(truth[:3]), ["a", "b", "c"], tmp_path / "grid.png", title="t", columns=2)
    assert read(tmp_path / "grid.png").max() == 255
