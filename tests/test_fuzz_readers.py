"""Damaged files of every kind are refused in words or read as finite numbers; tests/fuzz/run.py runs more of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Readers that let NaN through, crash, end the process and take too much, each of a file that is damaged.
PROGRAM = """
import os, sys
import corpus, run
from pathlib import Path
status = run.main(["--count", sys.argv[1], "--seed", "1"])
path = Path(sys.argv[2])
path.write_bytes(b"good")
faults = [lambda: float("nan"), lambda: [][1], lambda: os._exit(7), lambda: len(bytearray(os.urandom(1) * (200 << 20)))]
read = lambda fault: lambda p: 1.0 if p.read_bytes() == b"good" else fault()
run.readers = lambda folder: [corpus.Reader(f"r{i}", path, "binary", read(f), 1) for i, f in enumerate(faults)]
run.main(["--count", "4"])
sys.exit(status)
"""


def fuzz(count: int, file: Path) -> str:
    paths = [str(ROOT / p) for p in ("", "tests", "tests/fuzz", "src")] + [os.environ.get("PYTHONPATH", "")]
    command = [sys.executable, "-c", PROGRAM, str(count), str(file)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return done.stdout


@pytest.mark.parametrize("count", [300, pytest.param(20000, marks=pytest.mark.slow)])
def test_damaged_files_are_refused_in_words_and_the_runner_sees_faults(count: int, tmp_path: Path) -> None:
    told = fuzz(count, tmp_path / "x.bin")
    found = json.loads(told.splitlines()[0])
    assert found["cases"] == count == found["refused"] + found["read"] and found["readers"] >= 40
    # Most damage is seen; what is not, changed a number or a text into another.
    assert found["refused"] > 0.5 * count and found["read"] > 0.06 * count
    for fault in ("r0: gives result = nan", "r1: IndexError", "r2: ends the process (status 7)", "r3: takes "):
        assert fault in told
