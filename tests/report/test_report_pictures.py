"""Figures, videos and pictures of reports."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
from helpers.report_runs import config, evaluate, make_curves, make_pictures, page_of, write_run

from gausim.pictures.figures import contact_sheet, picture_grid, slice_figure
from gausim.pictures.frames import moving_line, space_time_slice
from gausim.report.media import Exhibit
from gausim.results.pictures import load_pictures, save_pictures


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


def write_two_rows(root: Path) -> Path:
    evaluate(write_run(root / "a", config()), make_curves(1.0))
    evaluate(write_run(root / "b", config(conserve_mass=False)), make_curves(2.0))
    return root


def image(figure: Exhibit) -> np.ndarray:
    assert figure.uri.startswith("data:image/webp;base64,")
    return cv2.imdecode(np.frombuffer(base64.b64decode(figure.uri.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)


def test_runs_without_pictures_leave_the_others_theirs(tmp_path):
    root = write_two_rows(tmp_path / "runs")
    (root / "a" / "evaluation" / "pictures.npz").unlink()
    (root / "b" / "evaluation" / "metrics.npz").write_bytes(b"PK\x03\x04 torn")
    page = page_of(root)
    kinds = [page.count(f"data:{kind};base64,") for kind in ("image/webp", "image/jpeg", "video/mp4")]
    assert kinds == [3, 1, 1] and "There is no video: its evaluation kept no pictures" in page
    notes = re.findall(r'<p class="note">(.*?)</p>', page, re.S)
    assert any("gausim:" in n and "kept no pictures" in n and "gausim evaluate" in n for n in notes)
    assert any("gausim w/o mass:" in n and "metrics.npz" in n for n in notes)


def test_pictures_round_trip(tmp_path):
    original = make_pictures()
    save_pictures(tmp_path / "p.npz", [original, make_pictures("other", background=False)])
    first, other = load_pictures(tmp_path / "p.npz")
    assert np.array_equal(first.truth, original.truth) and np.array_equal(first.background, original.background)
    assert np.array_equal(first.predictions["gausim"], original.predictions["gausim"])
    assert (first.object, first.views, first.first_unseen) == ("toy_bunny", ("x", "y"), 8)
    assert other.object == "other" and other.background is None
