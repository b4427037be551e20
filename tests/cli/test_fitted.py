"""Fitted methods through the same commands as the simulator: train, evaluate, report, simulate; resume; messages."""

from __future__ import annotations

import csv
import json
import runpy
from pathlib import Path

import pytest
import torch

from gausim.cli import evaluate, report, simulate, train
from gausim.cli._run import load_run
from gausim.core import ConfigError
from gausim.engine.checkpoint import read_checkpoint

write_toy_object = runpy.run_path(str(Path(__file__).parents[1] / "toy_object.py"))["write_toy_object"]

TINY = (
    "data.curriculum.t_max=3", "trainer.accelerator=cpu", "trainer.progress=false", "trainer.threads=1",
    "render=reference", "callbacks.panels.every_epochs=0", "name=toy",
)  # fmt: skip
SMALL: dict[str, list[str]] = {"static": []}


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_object(tmp_path_factory.mktemp("data") / "toy", frames=9).root


@pytest.fixture
def arguments(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return [f"data.root={toy}", *TINY]


@pytest.mark.parametrize("model", SMALL)
def test_the_same_commands_serve_every_method(model: str, arguments: list[str]) -> None:
    assert train.main([f"model={model}", *SMALL[model], *arguments]) == 0
    run = Path("outputs/toy/seed_0")
    assert evaluate.main([str(run)]) == 0
    entry = json.loads((run / "evaluation" / "metrics.json").read_text())["objects"]["toy"]
    assert entry["methods"] == [load_run(run).module.method.name] == [model]  # type: ignore[attr-defined]
    assert entry["footnotes"][model]["notes"] and entry["efficiency"][model]["seconds_per_frame"]["mean"] >= 0
    table = (run / "evaluation" / "table.md").read_text()
    assert all(note in table for note in entry["footnotes"][model]["notes"])
    assert simulate.main([str(run), "--frames", "12"]) == 0
    assert (run / "simulation" / "toy" / "seq_000" / "cam_0.mp4").is_file()
    assert report.main([str(run), "--out", "page"]) == 0
    written = "".join(p.read_text() for p in Path("page").iterdir() if p.suffix == ".md")
    assert model in written and ("Does not foresee" in written) == (not entry["footnotes"][model]["extrapolates"])
