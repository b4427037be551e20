"""Processes that others started end with them, even if these are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

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
