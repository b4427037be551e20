"""What the graph of a training step holds, and what the host waits for."""

from __future__ import annotations

import pytest
import torch
from helpers import sway
from helpers.sway import blobs, sample

from benchmarks.harness import peak_saved_bytes
from gausim.losses import Objective
from gausim.training.module import GausSimModule
from gausim.training.supervision import comparison


def real_module(objective: Objective) -> GausSimModule:
    parts = {"renderer": blobs, "objective": objective}
    return sway.real_module(edges="rest", layers=2, output_scale=0.1, parts=parts)


def optimise(module: GausSimModule, steps: int = 3, times: int = 1) -> dict[str, float]:
    optimizer = module.configure_optimizers()
    stats: dict[str, float] = {}
    for number in range(times):
        stats = module.optimise([sample(0, steps=steps)], optimizer, torch.Generator().manual_seed(number))
    return stats


@pytest.fixture
def one_state_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CPU_PIXELS", 1)


def held(objective: Objective, steps: int) -> int:
    return peak_saved_bytes(lambda: optimise(real_module(objective), steps))


def test_memory_does_not_grow_with_the_rollout_where_gradients_stop(one_state_at_once: None) -> None:
    stopped = Objective(backprop_steps=1, static_weight=0.0)
    assert held(stopped, 8) == held(stopped, 3) > 0
    whole = Objective(backprop_steps=0, static_weight=0.0)
    assert held(whole, 12) > 2 * held(whole, 3)
