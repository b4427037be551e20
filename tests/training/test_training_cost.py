"""What training cost is counted over interruptions and said once."""

from __future__ import annotations

import time

import torch

from gausim.runs.cost import TrainingCost


def test_cost_goes_on_where_a_checkpoint_ended() -> None:
    cost = TrainingCost()
    assert cost.notes() == [] and set(cost.summary().values()) == {0.0}
    time.sleep(0.05)
    first = cost.state_dict()
    assert 0.05 <= first["seconds"] < 5 and first["peak_bytes"] > 1e7 and first["cpu_seconds"] < first["seconds"]
    later = TrainingCost()
    later.load_state_dict({**first, "seconds": 120.0, "cpu_seconds": 90.0})
    later.begin()
    wall, processor = time.perf_counter(), time.process_time()
    while min(time.perf_counter() - wall, time.process_time() - processor) < 0.06:
        torch.rand(1000).sort()
    second = later.state_dict()
    assert second["seconds"] >= 120.05 and 90.05 <= second["cpu_seconds"] < 95
    assert second["peak_bytes"] >= first["peak_bytes"] and second == later.summary()
    assert later.notes() == [
        f"Trained in 2.0 minutes, 1.5 of processor time; it held {second['peak_bytes'] / 1e9:.1f} GB at most."
    ]
