from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gausim.core import RunError
from gausim.runs.checkpoint import AtomicCheckpointIO
from gausim.runs.comparison import changed_keys
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
