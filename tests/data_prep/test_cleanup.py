"""Cleaning of masks: holes, parts, flashes and edges."""

import numpy as np

from data_prep.capture.masks.cleanup import UNTOUCHED, Cleanup, cleaned, fill_holes, keep_largest, soften, steady


def square(top: int, left: int, side: int, size: int = 60) -> np.ndarray:
    mask = np.zeros((size, size), np.float32)
    mask[top : top + side, left : left + side] = 1
    return mask


def test_holes_and_parts_go_by_their_size() -> None:
    mask = square(10, 10, 40)
    mask[20:24, 20:24] = 0  # 1 % of the foreground
    mask[30:42, 30:42] = 0  # 9 %
    filled = fill_holes(mask, 0.02)
    assert (filled[20:24, 20:24] == 1).all() and (filled[30:42, 30:42] == 0).all()
    notch = square(0, 0, 40)
    notch[0:3, 10:13] = 0  # open to the border: no hole
    assert np.array_equal(fill_holes(notch, 0.5), notch)
    mask = np.maximum(square(5, 5, 30), square(45, 45, 8))
    mask[35:37, 5:35] = 0.3  # soft edge of the large one
    one, two = keep_largest(mask, 1, 0), keep_largest(mask, 2, 0)
    assert one[45:53, 45:53].max() == 0 and (one[35:37, 5:35] == np.float32(0.3)).all()
    assert two[45:53, 45:53].min() == 1


def test_flashes_in_time_go_and_motion_stays() -> None:
    """A blob of one frame vanishes, a frame's loss is mended, an edge that moves by 2 pixels a frame is left alone."""
    masks = [square(20, 10 + 2 * k, 20) for k in range(5)]
    neighbours = [(abs(k - 2), masks[k]) for k in (0, 1, 3, 4)]
    assert np.array_equal(steady(masks[2], neighbours, 2.0), masks[2])
    flash = np.maximum(masks[2], square(50, 50, 6))
    assert np.array_equal(steady(flash, neighbours, 2.0), masks[2])
    lost = masks[2].copy()
    lost[28:36, 20:28] = 0
    assert steady(lost, neighbours, 2.0)[28:36, 20:28].min() == 1
    assert np.array_equal(steady(flash, neighbours[:1], 2.0), flash)  # one neighbour is no majority


def test_edges_follow_the_picture() -> None:
    """A mask that is a pixel off is softened to the picture's edge; far from the edge nothing changes."""
    rgb = np.full((60, 60, 3), 30, np.uint8)
    rgb[20:40, 20:40] = 220
    soft = soften(square(19, 19, 22), rgb, 3)
    assert 0 < soft[30, 19] < soft[30, 21] and soft[30, 30] == 1 and soft[30, 10] == 0
    alpha = cleaned(square(19, 19, 22), rgb, Cleanup(edge=0.05), soft=False)
    assert alpha.dtype == np.uint8 and ((alpha == 0) | (alpha >= 12)).all() and len(np.unique(alpha)) > 3
    assert set(np.unique(cleaned(square(19, 19, 22), rgb, UNTOUCHED, soft=False))) == {0, 255}
