from __future__ import annotations

import math

import pytest
import torch

from gausim.benchmark import interact
from gausim.benchmark.harness import Options
from gausim.cli.benchmark import simulator_of


def test_the_stages_of_a_frame() -> None:
    rows = interact.run(Options(torch.device("cpu"), quick=True, rounds=1), simulator_of)
    (case,) = {row.case for row in rows}
    found = {row.metric: row.value for row in rows}
    assert case.startswith("300 kernels") and len(found) == len(rows)
    assert all(math.isfinite(value) and value >= 0 for value in found.values())
    assert found["simulated"] == pytest.approx(1 / found["step"])
    assert found["made one after the other"] < found["simulated"]
    assert all(found[name] > 0 for name in ("step", "colours", "packing"))
