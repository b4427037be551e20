from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.report_runs import config, evaluate, make_curves, make_pictures, page_of, study_of, write_run

from gausim.io.video import read_video
from gausim.report.media import Exhibit, object_figures
from gausim.results.pictures import load_pictures, save_pictures


def write_two_rows(root: Path) -> Path:
    evaluate(write_run(root / "a", config()), make_curves(1.0))
    evaluate(write_run(root / "b", config(conserve_mass=False)), make_curves(2.0))
    return root


def figures(root: Path) -> tuple[dict[str, Exhibit], list[str]]:
    made, problems = object_figures(study_of(root), "toy_bunny")
    return {figure.title.split(":")[0]: figure for figure in made}, problems


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> dict[str, Exhibit]:
    made, problems = figures(write_two_rows(tmp_path_factory.mktemp("runs")))
    assert not problems
    return made


def image(figure: Exhibit) -> np.ndarray:
    assert figure.uri.startswith("data:image/webp;base64,")
    return cv2.imdecode(np.frombuffer(base64.b64decode(figure.uri.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)


def test_every_picture_is_there_and_says_what_was_done_to_it(drawn):
    assert list(drawn) == ["Errors over time", "Space-time slices", "Frames", "Side by side"]
    for name, figure in drawn.items():
        if name != "Side by side":
            assert len(np.unique(image(figure).reshape(-1, 3), axis=0)) > 20
        if name != "Errors over time":
            assert "over the original background, brightened 1.92×" in figure.caption and "no number" in figure.caption


def test_the_video_shows_truth_and_predictions_over_the_background(drawn, tmp_path):
    figure = drawn["Side by side"]
    assert figure.kind == "video"
    (tmp_path / "v.mp4").write_bytes(base64.b64decode(figure.uri.split(",")[1]))
    frames = list(read_video(tmp_path / "v.mp4"))
    assert len(frames) == 20
    width = frames[0].shape[1] // 3
    ours = frames[10][24 : 24 + 168]  # below the labels: the trained camera
    colors = [ours[:, i * width : (i + 1) * width] for i in range(3)]
    assert all((c[..., 1] > 200).mean() > 0.7 for c in colors)  # the background's green
    where = [float(np.nonzero((c[..., 0] > 180).any(0))[0].mean()) for c in colors]  # the square's red
    # One pixel of 32 is 7 in the video: errors 1 and 2 shift it by 2 and 4 pixels.
    assert where[1] - where[0] == pytest.approx(14, abs=3) and where[2] - where[0] == pytest.approx(28, abs=3)


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
