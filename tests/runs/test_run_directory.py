from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.plain import edit_json
from helpers.toy_runs import Trainings

from gausim.cli.main import main
from gausim.compose.build import load_run
from gausim.core import RunError
from gausim.data.objects import ObjectData
from gausim.runs.checkpoint import AtomicCheckpointIO
from gausim.runs.comparison import changed_keys
from gausim.runs.data_print import changed_files, write_prints
from gausim.runs.directory import RunDirectory

CONFIG = {"seed": 0, "loss": {"balance": 0.9}, "trainer": {"threads": 1}, "plan": {"epochs": 3}, "output_root": "o"}


def test_a_fresh_and_an_interrupted_run_and_changed_keys(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "a")
    with pytest.raises(RunError, match="no run here"):
        run.config()
    assert run.prepare(CONFIG) is None
    assert run.config() == CONFIG
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}, "gausim": {}}, run.checkpoint)
    assert run.prepare(CONFIG) == run.checkpoint
    changed = {**CONFIG, "seed": 1, "output_root": "p", "trainer": {"threads": 2}, "plan": {"epochs": 4}}
    assert changed_keys(CONFIG, changed) == ["plan.epochs", "seed"]
    assert changed_keys(CONFIG, {**CONFIG, "extra": 1}) == ["extra"]
    run = RunDirectory(tmp_path)
    run.prepare(CONFIG)
    run.prepare(changed)  # nothing was learned yet
    run.checkpoint.write_bytes(b"x")
    with pytest.raises(RunError, match=r"changed: plan\.epochs, seed\."):
        run.prepare(CONFIG)


def test_a_finished_run_is_refused_and_overwriting_keeps_foreign_files(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    run.prepare(CONFIG)
    run.checkpoint.write_bytes(b"x")
    (tmp_path / "panels").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    run.finish({"epochs": 3})
    with pytest.raises(RunError, match="this run is finished"):
        run.prepare(CONFIG)
    assert run.prepare(CONFIG, overwrite=True) is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.yaml", "events.jsonl", "notes.txt"]
    assert "finished" not in (tmp_path / "events.jsonl").read_text()


def test_an_error_leaves_its_last_line_and_is_gone_when_tried_again(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    run.prepare(CONFIG)
    with pytest.raises(ZeroDivisionError), run.recording_failure(tmp_path.parent):
        1 / 0  # noqa: B018
    assert run.has_failed and run.failure() == "ZeroDivisionError: division by zero"
    assert "Traceback" in (tmp_path / "FAILED").read_text()
    with pytest.raises(RunError), run.recording_failure(tmp_path.parent):
        raise RunError("two\nlines")
    assert run.failure() == "RunError: two lines" and "Traceback" not in (tmp_path / "FAILED").read_text()
    with pytest.raises(KeyboardInterrupt), run.recording_failure(tmp_path.parent):
        run.prepare(CONFIG)
        raise KeyboardInterrupt
    assert not run.has_failed
    events = [json.loads(line)["event"] for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert events == ["started", "failed", "failed", "started"]


@pytest.mark.parametrize("stepped", [False, True])
def test_a_new_run_that_fails_before_its_first_step_leaves_nothing(tmp_path: Path, stepped: bool) -> None:
    run = RunDirectory(tmp_path / "out" / "name" / "seed_0")
    (run.path / ".hydra").mkdir(parents=True)
    (run.path / ".hydra" / "config.yaml").write_text("")
    with pytest.raises(ZeroDivisionError), run.recording_failure(tmp_path / "out"):
        run.prepare(CONFIG)
        run.has_stepped = stepped
        1 / 0  # noqa: B018
    assert (tmp_path / "out").exists() == stepped == run.has_failed
    again = RunDirectory(run.path)
    (tmp_path / "out" / "name" / "seed_0").mkdir(parents=True, exist_ok=True)
    (run.path / "notes.txt").write_text("mine")
    with pytest.raises(ZeroDivisionError), again.recording_failure(tmp_path / "out"):
        1 / 0  # noqa: B018
    assert (run.path / "notes.txt").read_text() == "mine" and again.has_failed == stepped


CHILD = "import sys, time; from gausim.runs.processes import end_with; end_with(int(sys.argv[1])); time.sleep(600)"
PARENT = (
    "import os, subprocess, sys\n"
    f"child = subprocess.Popen([sys.executable, '-c', {CHILD!r}, str(os.getpid())])\n"
    "print(child.pid, flush=True)\nchild.wait()"
)
WORKERS = (
    "import time; from data_prep.common.progress import each, silent\n"
    "if __name__ == '__main__': each(time.sleep, [(600,), (600,)], workers=2, step='', tick=silent)"
)


def until(what: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in found if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_child_ends_with_its_parent(how: signal.Signals) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert alive(child)
    parent.send_signal(how)
    parent.wait()
    until(lambda: not alive(child))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_of_a_killed_stage_end(tmp_path: Path) -> None:
    (tmp_path / "stage.py").write_text(WORKERS)
    path = os.pathsep.join(sys.path)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "stage.py")], env={**os.environ, "PYTHONPATH": path})
    until(lambda: len(children(parent.pid)) == 2)
    workers = children(parent.pid)
    time.sleep(5)  # they begin to work
    parent.kill()
    parent.wait()
    until(lambda: not any(map(alive, workers)))


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
