"""Weights & Biases and MLflow: one run per run directory, each row once, one end per job."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.offline_run import read_offline_run

from gausim.core import ConfigError, RunError
from gausim.training.loggers.files import Resumable
from gausim.training.loggers.media import Clip, Media, MediaLog, write_media
from gausim.training.loggers.mlflow import MLFLOW_ID, MlflowLog
from gausim.training.loggers.wandb import WANDB_ID, WandbLog

CONFIG = {"model": {"layers": 2}, "seed": 3}


def media_at(run: Path, step: int) -> Media:
    images = np.zeros((3, 16, 16, 3), np.uint8)
    images[np.arange(3), 4:8, np.arange(3)] = 200
    errors = {"prediction": np.arange(3.0), "static": np.arange(3.0) * 2}
    clip = Clip("toy_a", "toy/a", 24.0, images, images[::-1].copy(), errors)
    return write_media(run, step, [clip], ["object", "l2"], [["toy", "1.5"]])


class FakeRun:
    def __init__(self, given: dict[str, Any], start: int) -> None:
        self.given, self.starting_step = given, start
        self.rows: list[tuple[int, dict[str, Any]]] = []
        self.exits: list[int] = []
        folder = Path(given["dir"]) / "wandb" / f"offline-run-{len(FakeWandb.runs)}-{given['id']}" / "files"
        folder.mkdir(parents=True)
        self.dir = str(folder)

    def log(self, values: dict[str, Any], step: int | None = None, commit: bool | None = None) -> None:
        assert not self.exits, "logged after its end"
        if values:
            assert step is not None and (not self.rows or step >= self.rows[-1][0]), "steps must not go back"
            self.rows.append((step, values))
        np.random.rand()  # a library may draw; training must not notice

    def finish(self, exit_code: int) -> None:
        self.exits.append(exit_code)


class FakeWandb:
    runs: list[FakeRun] = []
    start, broken = 0, False
    Error = type("Error", (Exception,), {})
    plot = SimpleNamespace(line_series=lambda *a, **k: ("plot", a, k))

    @classmethod
    def init(cls, **given: Any) -> FakeRun:
        np.random.rand()
        if cls.broken:
            raise cls.Error("no answer from the server")
        cls.runs.append(FakeRun(given, cls.start))
        return cls.runs[-1]

    Settings = staticmethod(lambda **k: k)
    Video = staticmethod(lambda path, **k: ("video", path))
    Image = staticmethod(lambda path: ("image", path))
    Table = staticmethod(lambda columns, data: ("table", columns, data))


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeWandb]:
    FakeWandb.runs, FakeWandb.start, FakeWandb.broken = [], 0, False
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb)
    return FakeWandb


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


def test_an_online_run_is_sent_what_the_server_has_not_and_ended_once(fake: type[FakeWandb], tmp_path: Path) -> None:
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


def test_a_server_that_does_not_answer_is_a_named_error(fake: type[FakeWandb], tmp_path: Path) -> None:
    fake.broken = True
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
        assert {"media/toy_a/video", "media/toy_a/frames", "media/toy_a/slice", "media/objects"} <= shown
        video = folder / "files" / rows[step]["media/toy_a/video/path"]
        assert video.read_bytes() == (tmp_path / "panels" / f"step_{step:06d}" / "toy_a.mp4").read_bytes()


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
    assert {f"media/step_000008/toy_a{end}" for end in (".mp4", ".frames.png", ".errors.png")} < files


def test_mlflow_is_asked_for_by_name_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausim.training.loggers.mlflow.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'gausim\[mlflow\]'"):
        MlflowLog(tmp_path, database=tmp_path / "mlflow.db")
