from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.simulators import LEVELS
from helpers.toy_object import write_toy_object

from gausim.runs.checkpoint import read_checkpoint


@pytest.mark.slow  # compiles everything from nothing
def test_the_process_that_compiles_trains_to_the_same_bits_as_one_that_loads_from_the_cache(tmp_path: Path) -> None:
    toy = write_toy_object(tmp_path / "toy", frames=8).root
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "compiled"), "OMP_NUM_THREADS": "1"}
    states, compiled = [], []
    for run in ("first", "second"):
        command = [
            sys.executable, "-m", "gausim.cli.main", "train", f"data.root={toy}", "render=cpu", "trainer.threads=1",
            "trainer.accelerator=cpu", "trainer.max_epochs=2", "trainer.progress=false", "data.curriculum.t_max=3",
            "data.repeats=1", "data.batch_size=2", LEVELS,
            "logger=none", f"hydra.run.dir={tmp_path / run}",
        ]  # fmt: skip
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        (checkpoint,) = tmp_path.glob(f"{run}/**/last.ckpt")
        states.append(read_checkpoint(checkpoint)["state_dict"])
        compiled.append({file: file.stat().st_mtime_ns for file in (tmp_path / "compiled").rglob("*.nbc")})
    assert compiled[0] and compiled[0] == compiled[1]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
