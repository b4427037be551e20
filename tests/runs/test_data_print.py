"""Changes of the data under a run: noticed, and said in a sentence, by all that read them again."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.plain import edit_json
from helpers.toy_runs import Trainings

from gausim.cli.main import main
from gausim.compose.build import load_run
from gausim.core import RunError
from gausim.data.objects import ObjectData
from gausim.runs.data_print import changed_files, write_prints

FRAME = "sequences/seq_000/cam_1/0003.png"


def replaced(root: Path) -> None:
    shutil.copy(root / "sequences/seq_000/cam_1/0004.png", root / FRAME)


def same_size(root: Path) -> None:
    content = bytearray((root / FRAME).read_bytes())
    content[-20] ^= 1
    (root / FRAME).write_bytes(content)


def behind_a_link(root: Path) -> None:
    other = root.parent / "other.png"
    shutil.move(root / FRAME, other)
    (root / FRAME).symlink_to(other)
    shutil.copy(root / "sequences/seq_000/cam_1/0004.png", other)


CHANGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing": (lambda root: None, ""),
    "times": (lambda root: os.utime(root / FRAME, (1, 1)), ""),
    "added": (lambda root: (root / "sequences/seq_000/note.txt").write_text("x"), ""),
    "replaced": (replaced, FRAME),
    "same size": (same_size, FRAME),
    "removed": (lambda root: (root / FRAME).unlink(), FRAME),
    "behind a link": (behind_a_link, FRAME),
    "a pose": (lambda root: edit_json(root / "sequences/seq_001/transforms.json", lambda d: d.update(note=1)),
               "sequences/seq_001/transforms.json"),
    "the facts": (lambda root: edit_json(root / "dataset.json", lambda d: d.update(heldout_views=[])), "dataset.json"),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_changed_files_are_named(change: str, toy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(toy, tmp_path / "data")
    write_prints(tmp_path, [ObjectData(root)])
    alter, named = CHANGES[change]
    alter(root)
    told = changed_files(tmp_path, [ObjectData(root)])
    assert ("1 of 123 files were replaced" in told and f"({named})" in told) if named else told == ""
    assert changed_files(tmp_path, [ObjectData(shutil.copytree(toy, tmp_path / "elsewhere"))]) == ""


def test_every_command_says_so(trainings: Trainings, toy: Path, tmp_path: Path, caplog, capsys) -> None:
    root = shutil.copytree(toy, tmp_path / "data")
    own = (f"data.root={root}", "data.sequences=1", "plan.epochs=1", f"output_root={tmp_path}")
    assert trainings("changed", *own)[0] == 0
    run = tmp_path / "changed" / "seed_0"
    replaced(root)
    with caplog.at_level(logging.WARNING):
        load_run(run)
    assert FRAME in caplog.text
    (run / "FINISHED").unlink()
    status, told = trainings("changed", *own)
    assert status == 2 and FRAME in told and "Restore them to resume" in told
    shutil.rmtree(root / "sequences/seq_000")
    with pytest.raises(RunError, match=r"trained on \['seq_000'\], but the data now give \['seq_001'\]"):
        load_run(run)
    capsys.readouterr()
    for command in ("evaluate", "simulate", "adapt"):
        assert main([command, str(run)]) == 2
        assert "seq_000 is gone" in capsys.readouterr().err
    shutil.copytree(root / "sequences/seq_001", root / "sequences/seq_000")
    assert "seq_000 is gone" not in trainings("changed", *own)[1]
    status, told = trainings("changed", *own, "data.sequences=null")
    assert status == 2 and "changed: data.sequences" in told
