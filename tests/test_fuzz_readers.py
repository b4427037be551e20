"""Damaged files of every kind are refused in words or read as finite numbers; tests/fuzz/run.py runs more of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def fuzz(*arguments: str) -> dict:
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(ROOT / "tests" / "fuzz" / "run.py"), *arguments]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_a_slice_of_the_damaged_files() -> None:
    found = fuzz("--count", "500", "--seed", "1")
    assert found["cases"] == 500 == found["refused"] + found["read"] and found["readers"] >= 40
    # Most damage is seen; what is not, changed a number or a text into another.
    assert found["refused"] > 250 and found["read"] > 30


@pytest.mark.slow
def test_twenty_thousand_damaged_files() -> None:
    found = fuzz("--count", "20000")
    assert found["cases"] == 20000 == found["refused"] + found["read"]


def test_the_runner_sees_faults(tmp_path: Path) -> None:
    """A reader that lets NaN through, one that crashes, one that ends the process, one that takes too much."""
    program = f"""
import os, runpy, sys
sys.path.insert(0, {str(ROOT / "tests" / "fuzz")!r})
import corpus
from pathlib import Path
path = Path({str(tmp_path)!r}) / "x.bin"
path.write_bytes(b"good")
good = lambda p: p.read_bytes() == b"good"
reads = [
    lambda p: 1.0 if good(p) else float("nan"),
    lambda p: 1.0 if good(p) else [][1],
    lambda p: 1.0 if good(p) else os._exit(7),
    lambda p: 1.0 if good(p) else len(bytearray(os.urandom(1) * (200 << 20))),
]
corpus.readers = lambda folder: [corpus.Reader(f"r{{i}}", path, "binary", r, 1) for i, r in enumerate(reads)]
sys.argv = ["run.py", "--count", "4"]
runpy.run_path({str(ROOT / "tests" / "fuzz" / "run.py")!r}, run_name="__main__")
"""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": paths}, capture_output=True,
                          text=True)  # fmt: skip
    assert done.returncode == 1, done.stderr[-2000:]
    for fault in ("r0: gives result = nan", "r1: IndexError", "r2: ends the process (status 7)", "r3: takes "):
        assert fault in done.stdout, done.stdout
