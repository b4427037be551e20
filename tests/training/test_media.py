"""Media of a run as files, and what TensorBoard makes of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gausim.io.video import read_video, video_rate
from gausim.training.loggers.files import CsvLog, TensorBoardLog
from gausim.training.loggers.media import (
    LEAST_ROWS,
    MOST_ROWS,
    Clip,
    Media,
    MediaLog,
    forget_media,
    media_of,
    slice_panel,
    write_media,
)

COLUMNS, ROWS = ["object", "l2 x1000"], [["toy", "1.5"]]


def moving_square(shift: int, *, frames: int = 5, size: int = 40) -> np.ndarray:
    images = np.zeros((frames, size, size, 3), np.uint8)
    for f in range(frames):
        images[f, 10:20, f + shift : f + shift + 10] = (200, 100, 50)
    return images


def make_clip(name: str = "toy_seq_000", *, size: int = 40) -> Clip:
    errors = {"prediction": np.array([0.0, 1, 2, 3, 4]), "static": np.array([0.0, 2, 4, np.nan, 8])}
    return Clip(name, "toy/seq_000 cam", 24.0, moving_square(0, size=size), moving_square(3, size=size), errors)


def media_at(run: Path, step: int, **options: int) -> Media:
    return write_media(run, step, [make_clip(**options)], COLUMNS, ROWS)


def test_the_files_say_what_was_predicted(tmp_path: Path) -> None:
    media = media_at(tmp_path, 12)
    assert media.folder == tmp_path / "panels" / "step_000012" and media.names == ["toy_seq_000"]
    video = list(read_video(media.video("toy_seq_000")))
    assert len(video) == 5 and video_rate(media.video("toy_seq_000")) == 24.0
    width = video[0].shape[1] // 3
    truth, prediction, error = (video[0][24 : 24 + LEAST_ROWS, i * width : (i + 1) * width] for i in range(3))
    red = [int(np.abs(half.astype(int) - (200, 100, 50)).sum(-1).argmin() % width) for half in (truth, prediction)]
    assert red[1] - red[0] == pytest.approx(3 * LEAST_ROWS / 40, abs=8)
    assert error.max() > 100 > error[-20:].max()
    columns, rows = media.errors("toy_seq_000")
    assert columns == ["frame", "prediction", "static"] and rows[3] == ["3", "3", ""]
    assert media.objects() == (COLUMNS, ROWS)
    assert {kind: cv2.imread(str(p)) is not None for kind, p in media.pictures("toy_seq_000").items()} == {
        "frames": True, "slice": True,
    }  # fmt: skip


def test_large_images_are_shrunk_and_none_is_enlarged_beyond_need(tmp_path: Path) -> None:
    media = media_at(tmp_path, 1, size=600)
    frame = next(iter(read_video(media.video("toy_seq_000"))))
    assert frame.shape[1] == 3 * MOST_ROWS
    assert media.video("toy_seq_000").stat().st_size < 200_000


def test_a_slice_shows_the_line_that_moves() -> None:
    still = moving_square(0)
    panel = slice_panel(still, still)
    part = len(panel) // 3
    truth, error = panel[24:part], panel[2 * part + 24 :]
    lit = [bool(truth[:, truth.shape[1] * f // 5 + 8].any()) for f in range(5)]
    assert len(set(lit)) == 2  # the square comes to the line, or leaves it
    assert error.max() == error.min(axis=(0, 1)).max()  # one colour: no error anywhere


def test_media_of_steps_that_are_done_again_go(tmp_path: Path) -> None:
    for step in (4, 8, 12):
        media_at(tmp_path, step)
    (tmp_path / "panels" / ".step_000016.tmp").mkdir()
    forget_media(tmp_path, 8)
    assert [m.step for m in media_of(tmp_path)] == [4, 8]
    assert sorted(p.name for p in (tmp_path / "panels").iterdir()) == ["step_000004", "step_000008"]
    media_at(tmp_path, 8)  # written again over what is there
    assert media_of(tmp_path)[-1].names == ["toy_seq_000"]


def test_tensorboard_has_video_pictures_errors_table_and_config(tmp_path: Path) -> None:
    logger = TensorBoardLog(tmp_path)
    assert isinstance(logger, MediaLog) and not isinstance(CsvLog(tmp_path), MediaLog)
    logger.log_hyperparams({"model": {"layers": 2}})
    logger.log_media(media_at(tmp_path, 8))
    logger.log_media(media_at(tmp_path, 16))
    logger.save()
    first = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {f"toy_seq_000/{kind}" for kind in ("video", "frames", "slice", "errors")} == set(first.Tags()["images"])
    video = first.Images("toy_seq_000/video")
    assert [e.step for e in video] == [8, 16] and video[0].encoded_image_string[:6] == b"GIF89a"
    assert first.Images("toy_seq_000/errors")[0].width == 500
    texts = {tag: first.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in first.Tags()["tensors"]}
    assert "layers: 2" in texts["config/text_summary"] and "| toy | 1.5 |" in texts["objects/text_summary"]

    again = TensorBoardLog(tmp_path)
    again.resume_at(8)
    again.save()
    resumed = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [e.step for e in resumed.Images("toy_seq_000/video")] == [8]
