from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from gausim.core import GaussianScene, RunError
from gausim.engine.checkpoint import (
    AtomicCheckpointIO,
    WeightAverage,
    check_scenes,
    fingerprints,
    load_weights,
    read_checkpoint,
)


def scene(shift: float = 0.0) -> GaussianScene:
    means = torch.arange(12.0).reshape(4, 3) + shift
    return GaussianScene.create(
        means=means, log_scales=torch.zeros(4, 3), quats=torch.ones(4, 4), opacity_logits=torch.zeros(4),
        sh=torch.zeros(4, 1, 3), pinned=means[:, 0] < 1, name="block",
    )  # fmt: skip


def checkpoint(value: float = 1.0) -> dict:
    own = {"scenes": fingerprints([scene()]), "average": WeightAverage(0.0).state_dict()}
    return {"state_dict": {"weight": torch.full((2, 3), value)}, "gausim": own}


def test_written_and_read_without_running_code(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)
    assert float(torch.load(path, weights_only=True)["state_dict"]["weight"].sum()) == 12.0
    assert [p.name for p in path.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_save_keeps_the_last_good_file(failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)

    def refuse(*_: object) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(os, failing, refuse)
        with pytest.raises(RunError, match="disk full"):
            AtomicCheckpointIO().save_checkpoint(checkpoint(3.0), path)
    assert float(read_checkpoint(path)["state_dict"]["weight"][0, 0]) == 2.0
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]


def test_what_reads_back_differently_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(checkpoint(2.0), path)
    save = torch.save
    monkeypatch.setattr(torch, "save", lambda obj, file: save(checkpoint(9.0), file))
    with pytest.raises(RunError, match="other contents"):
        AtomicCheckpointIO().save_checkpoint(checkpoint(3.0), path)
    assert float(read_checkpoint(path)["state_dict"]["weight"][0, 0]) == 2.0


def test_code_in_a_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="weights_only|Weights only|other contents|could not be written"):
        AtomicCheckpointIO().save_checkpoint({**checkpoint(), "module": nn.Linear(2, 2)}, tmp_path / "last.ckpt")
    assert list(tmp_path.iterdir()) == []


def test_damaged_foreign_and_missing_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    with pytest.raises(RunError, match="no such checkpoint"):
        read_checkpoint(path)
    AtomicCheckpointIO().save_checkpoint(checkpoint(), path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(RunError, match=r"last\.ckpt: cannot be read"):
        read_checkpoint(path)
    torch.save({"state_dict": {}}, path)
    with pytest.raises(RunError, match="expected a checkpoint of gausim"):
        read_checkpoint(path)


def test_another_scene_is_refused_naming_both() -> None:
    check_scenes(checkpoint(), [scene()], "run/last.ckpt")
    other = replace(scene(shift=0.5), name="vase")
    with pytest.raises(RunError, match=r"run/last\.ckpt was trained on 'block'.*'vase'"):
        check_scenes(checkpoint(), [other], "run/last.ckpt")


def test_the_average_follows_the_weights_and_is_what_loads() -> None:
    module = nn.Linear(3, 2)
    average = WeightAverage(0.9)
    for value in (0.0, 1.0, 1.0, 1.0):
        nn.init.constant_(module.weight, value)
        average.update(module)
    saved = {"state_dict": module.state_dict(), "gausim": {"average": average.state_dict()}}
    averaged, plain = nn.Linear(3, 2), nn.Linear(3, 2)
    load_weights(averaged, saved)
    load_weights(plain, saved, averaged=False)
    assert 0.5 < float(averaged.weight[0, 0].detach()) < 1.0
    assert float(plain.weight[0, 0].detach()) == 1.0
    with pytest.raises(RunError, match="does not fit"):
        load_weights(nn.Linear(4, 2), saved)
