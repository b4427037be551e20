"""Stages of data preparation: all or nothing, the same again is left alone, what was interrupted goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from data_prep.common.stage import MANIFEST, Stage, read_manifest, run_stage
from gausim.core import DataError
from gausim.io.files import write_durably


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    film = tmp_path / "film.bin"
    film.write_bytes(b"frames")
    return Stage("ingest", 1, {"film": film}, {"rate": 24, "names": ("a", "b")}, packages=("numpy", "no-such-package"))


def make(work: Path) -> dict[str, Any]:
    write_durably(work / "a.txt", b"made")
    return {"frames": 6}


def test_result_carries_what_it_was_made_of(stage: Stage, tmp_path: Path) -> None:
    manifest = run_stage(stage, tmp_path / "out", make)
    stored = read_manifest(tmp_path / "out", "ingest")
    assert manifest == {**stored, "made": True}
    assert stored["results"] == {"frames": 6} and stored["settings"] == {"rate": 24, "names": ["a", "b"]}
    assert stored["inputs"]["film"]["bytes"] == 6 and len(stored["inputs"]["film"]["sha256"]) == 64
    assert stored["versions"]["no-such-package"] == "absent" and stored["versions"]["numpy"][0].isdigit()
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.txt", MANIFEST]


@pytest.mark.parametrize("change", ["input", "setting", "revision"])
def test_another_result_is_replaced_only_by_force(stage: Stage, tmp_path: Path, change: str) -> None:
    run_stage(stage, tmp_path / "out", make)
    if change == "input":
        stage.inputs["film"].write_bytes(b"other!")
    other = Stage("ingest", 2 if change == "revision" else 1, stage.inputs,
                  {"rate": 25} if change == "setting" else stage.settings)  # fmt: skip
    with pytest.raises(DataError, match="--overwrite"):
        run_stage(other, tmp_path / "out", make)
    assert read_manifest(tmp_path / "out")["results"] == {"frames": 6}
    assert run_stage(other, tmp_path / "out", lambda work: {"frames": 7}, overwrite=True)["results"] == {"frames": 7}
    assert not (tmp_path / "out" / "a.txt").exists()


@pytest.mark.parametrize("same", [True, False])
def test_interrupted_work_goes_on_with_the_same_settings_alone(stage: Stage, tmp_path: Path, same: bool) -> None:
    def fail(work: Path) -> dict[str, Any]:
        write_durably(work / "first", b"1")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_stage(stage, tmp_path / "out", fail)
    assert not (tmp_path / "out").exists()
    again = stage if same else Stage("ingest", 1, stage.inputs, {"rate": 25})
    run_stage(again, tmp_path / "out", lambda work: {})
    assert (tmp_path / "out" / "first").is_file() == same


def test_strangers_are_not_touched(stage: Stage, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    for overwrite in (False, True):
        with pytest.raises(DataError, match="not the result of a stage"):
            run_stage(stage, tmp_path / "out", make, overwrite=overwrite)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "x"


def test_missing_inputs_and_broken_manifests_are_named(stage: Stage, tmp_path: Path) -> None:
    stage.inputs["film"].unlink()
    with pytest.raises(DataError, match=r"film\.bin: not found"):
        run_stage(stage, tmp_path / "out", make)
    with pytest.raises(DataError, match=r"stage\.json: not found"):
        read_manifest(tmp_path)
    for text, what in (("{", "not the manifest"), ("[]", "not the manifest"), (json.dumps({"stage": "x"}), "expected")):
        (tmp_path / MANIFEST).write_text(text)
        with pytest.raises(DataError, match=what):
            read_manifest(tmp_path, "ingest")
