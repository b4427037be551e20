"""Media of a run as files; what TensorBoard, Weights & Biases and MLflow show: each row once, one end per job."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.fake_wandb import fake_wandb
from helpers.offline_run import read_offline_run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gausim.core import ConfigError, RunError
from gausim.io.video import read_video, video_rate
from gausim.training.loggers.files import CsvLog, Resumable, TensorBoardLog
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
from gausim.training.loggers.mlflow import MLFLOW_ID, MlflowLog
from gausim.training.loggers.wandb import WANDB_ID, WandbLog

CONFIG = {"model": {"layers": 2}, "seed": 3}
NAME = "toy_seq_000"
COLUMNS, ROWS = ["object", "l2 x1000"], [["toy", "1.5"]]


def moving_square(shift: int, *, frames: int = 5, size: int = 40) -> np.ndarray:
    images = np.zeros((frames, size, size, 3), np.uint8)
    for f in range(frames):
        images[f, 10:20, f + shift : f + shift + 10] = (200, 100, 50)
    return images


def media_at(run: Path, step: int, *, size: int = 40) -> Media:
    errors = {"prediction": np.array([0.0, 1, 2, 3, 4]), "static": np.array([0.0, 2, 4, np.nan, 8])}
    clip = Clip(NAME, "toy/seq_000 cam", 24.0, moving_square(0, size=size), moving_square(3, size=size), errors)
    return write_media(run, step, [clip], COLUMNS, ROWS)


def test_the_files_say_what_was_predicted(tmp_path: Path) -> None:
    media = media_at(tmp_path, 12)
    assert media.folder == tmp_path / "panels" / "step_000012" and media.names == [NAME]
    video = list(read_video(media.video(NAME)))
    assert len(video) == 5 and video_rate(media.video(NAME)) == 24.0
    width = video[0].shape[1] // 3
    truth, prediction, error = (video[0][24 : 24 + LEAST_ROWS, i * width : (i + 1) * width] for i in range(3))
    red = [int(np.abs(half.astype(int) - (200, 100, 50)).sum(-1).argmin() % width) for half in (truth, prediction)]
    assert red[1] - red[0] == pytest.approx(3 * LEAST_ROWS / 40, abs=8)
    assert error.max() > 100 > error[-20:].max()
    columns, rows = media.errors(NAME)
    assert columns == ["frame", "prediction", "static"] and rows[3] == ["3", "3", ""]
    assert media.objects() == (COLUMNS, ROWS)
    assert {kind: cv2.imread(str(p)) is not None for kind, p in media.pictures(NAME).items()} == {
        "frames": True, "slice": True,
    }  # fmt: skip


def test_large_images_are_shrunk_and_none_is_enlarged_beyond_need(tmp_path: Path) -> None:
    media = media_at(tmp_path, 1, size=600)
    frame = next(iter(read_video(media.video(NAME))))
    assert frame.shape[1] == 3 * MOST_ROWS
    assert media.video(NAME).stat().st_size < 200_000


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
    assert media_of(tmp_path)[-1].names == [NAME]


def test_tensorboard_has_video_pictures_errors_table_and_config(tmp_path: Path) -> None:
    logger = TensorBoardLog(tmp_path)
    assert isinstance(logger, MediaLog) and not isinstance(CsvLog(tmp_path), MediaLog)
    logger.log_hyperparams({"model": {"layers": 2}})
    logger.log_media(media_at(tmp_path, 8))
    logger.log_media(media_at(tmp_path, 16))
    logger.save()
    first = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {f"{NAME}/{kind}" for kind in ("video", "frames", "slice", "errors")} == set(first.Tags()["images"])
    video = first.Images(f"{NAME}/video")
    assert [e.step for e in video] == [8, 16] and video[0].encoded_image_string[:6] == b"GIF89a"
    assert first.Images(f"{NAME}/errors")[0].width == 500
    texts = {tag: first.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in first.Tags()["tensors"]}
    assert "layers: 2" in texts["config/text_summary"] and "| toy | 1.5 |" in texts["objects/text_summary"]

    again = TensorBoardLog(tmp_path)
    again.resume_at(8)
    again.save()
    resumed = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [e.step for e in resumed.Images(f"{NAME}/video")] == [8]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Any:
    return fake_wandb(monkeypatch)


def train_a_part(run: Path, resume_at: int, steps: range, *, offline: bool = True, status: str = "success") -> None:
    """What a job does with its logger."""
    logger = WandbLog(run, offline=offline, group="g/none/m", name="seed_3", tags=["a"])
    logger.log_hyperparams(CONFIG)
    logger.resume_at(resume_at)
    for step in steps:
        logger.log_metrics({"train/loss": 1 / step}, step)
        if step % 4 == 0:
            logger.log_media(media_at(run, step))
            logger.log_metrics({"epoch/loss": 2 / step}, step)
            logger.save()
    logger.finalize(status)
    logger.finalize(status)  # Lightning may say so twice


def test_an_online_run_is_sent_what_the_server_has_not_and_ended_once(fake: Any, tmp_path: Path) -> None:
    WandbLog(tmp_path).finalize("failed")  # nothing was begun, nothing is to be ended
    assert fake.runs == []
    np.random.seed(1)  # not Python's generator, which the type checker of the tests draws from
    train_a_part(tmp_path, 0, range(1, 7), offline=False, status="failed")
    drawn = np.random.rand()
    np.random.seed(1)
    assert drawn == np.random.rand()
    fake.start = 6  # the server has steps up to 5; step 6 was lost, the checkpoint is of step 4
    train_a_part(tmp_path, 4, range(5, 8), offline=False)
    first, second = fake.runs
    assert second.given["mode"] == "online" and second.given["resume"] == "allow"
    assert second.given["reinit"] == "create_new" and second.given["id"] == first.given["id"]
    assert [step for step, _ in second.rows] == [6, 7] and (first.exits, second.exits) == ([1], [0])


def test_a_server_that_does_not_answer_is_a_named_error(fake: Any, tmp_path: Path) -> None:
    fake.init.side_effect = fake.Error("no answer from the server")
    with pytest.raises(RunError, match=r"logger\.wandb.*WANDB_API_KEY.*offline=true"):
        WandbLog(tmp_path, offline=False).resume_at(0)


def wait_for_the_end(folder: Path) -> dict[str, Any]:
    """A process of its own writes the file, and may still be at it."""
    for _ in range(600):
        found = read_offline_run(folder)
        if found["exits"]:
            return found
        time.sleep(0.1)
    raise AssertionError(f"{folder}: the run has no end after a minute")


def test_a_real_offline_run_holds_everything_also_after_a_resume(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    train_a_part(tmp_path, 0, range(1, 7), status="failed")
    train_a_part(tmp_path, 4, range(5, 9))
    (folder,) = (tmp_path / "wandb").glob("offline-run-*")
    found = wait_for_the_end(folder)
    assert found["run"].run_id == (tmp_path / WANDB_ID).read_text() and found["run"].run_group == "g/none/m"
    assert found["run"].display_name == "seed_3" and found["config"]["model"] == {"layers": 2}
    assert found["exits"] == [0]
    rows = {row["_step"]: row for row in found["rows"] if set(row) - {"_step", "_runtime", "_timestamp"}}
    assert sorted(rows) == list(range(1, 9)) and len(found["rows"]) == len(rows)
    assert [rows[s]["train/loss"] for s in sorted(rows)] == [1 / s for s in range(1, 9)]
    assert rows[4]["epoch/loss"] == 0.5
    for step in (4, 8):
        shown = {name.rsplit("/", 1)[0] for name in rows[step] if name.startswith("media/")}
        assert {*(f"media/{NAME}/{kind}" for kind in ("video", "frames", "slice")), "media/objects"} <= shown
        video = folder / "files" / rows[step][f"media/{NAME}/video/path"]
        assert video.read_bytes() == (tmp_path / "panels" / f"step_{step:06d}" / f"{NAME}.mp4").read_bytes()


def mlflow_part(run: Path, resume_at: int, steps: range, status: str) -> None:
    logger = MlflowLog(run, database=run.parent / "mlflow.db", experiment="g/none/m", name="seed_3")
    assert isinstance(logger, Resumable) and isinstance(logger, MediaLog)
    logger.log_hyperparams(CONFIG)
    logger.resume_at(resume_at)
    for step in steps:
        logger.log_metrics({"train/loss": 1 / step, "never finite": float("nan")}, step)
    logger.log_media(media_at(run, steps.stop - 1))
    logger.finalize(status)
    logger.finalize("failed")


@pytest.mark.slow  # MLflow makes its data base for seconds
def test_mlflow_has_each_number_once_and_the_media(tmp_path: Path) -> None:
    tracking = pytest.importorskip("mlflow.tracking", reason="needs the extra 'mlflow'")
    run = tmp_path / "seed_3"
    mlflow_part(run, 0, range(1, 7), "failed")
    mlflow_part(run, 4, range(5, 9), "success")
    client = tracking.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("g/none/m")
    (kept,) = client.search_runs([experiment.experiment_id])
    assert kept.info.run_id == (run / MLFLOW_ID).read_text() and kept.info.status == "FINISHED"
    assert kept.info.run_name == "seed_3" and kept.data.params == {"model.layers": "2", "seed": "3"}
    history = client.get_metric_history(kept.info.run_id, "train/loss")
    assert [(m.step, m.value) for m in history] == [(s, 1 / s) for s in range(1, 9)]
    files = {f.path for f in client.list_artifacts(kept.info.run_id, "media/step_000008")}
    assert {f"media/step_000008/{NAME}{end}" for end in (".mp4", ".frames.png", ".errors.png")} < files


def test_mlflow_is_asked_for_by_name_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausim.training.loggers.mlflow.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'gausim\[mlflow\]'"):
        MlflowLog(tmp_path, database=tmp_path / "mlflow.db")
