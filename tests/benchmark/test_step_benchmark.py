from __future__ import annotations

import pytest
import torch

from gausim.benchmark import step
from gausim.benchmark.harness import Options
from gausim.cli.benchmark import simulator_of

QUICK = Options(torch.device("cpu"), quick=True, rounds=1)


@pytest.mark.slow
def test_every_figure_of_the_step_is_reported() -> None:
    torch.manual_seed(0)
    rows = step.run(QUICK, simulator_of)
    found = {(row.case, row.metric): row.value for row in rows}
    assert len(found) == len(rows)
    paper, flat, training = list(dict.fromkeys(row.case for row in rows))
    assert paper.startswith("step, 400 kernels") and flat.endswith("no hierarchy") and "2 x 300 kernels" in training
    for case in (paper, training):
        for metric in ("forward", "forward + backward"):
            assert found[case, metric] > 0 and found[case, f"{metric}, outside the network"] < 1
    assert found[flat, "edges"] > found[paper, "edges"] > 0
    for metric in ("forward", "forward + backward", "kept for the backward pass"):
        assert found[flat, f"{metric} / with hierarchy"] > 0
    parts = [metric for case, metric in found if case == paper and metric.startswith("forward, ")]
    assert len(parts) == 9 and all(found[paper, metric] > 0 for metric in parts[1:])


def test_no_backward_pass_where_memory_would_not_do(monkeypatch, capsys) -> None:
    monkeypatch.setattr(step, "_available_memory", lambda device: 0)
    rows = step.run(QUICK, simulator_of)
    assert "has no backward pass" in capsys.readouterr().err
    flat = [row.metric for row in rows if row.case.endswith("no hierarchy")]
    assert flat == ["edges", "forward", "forward / with hierarchy"]


def test_levels_are_found_that_have_the_units_wanted() -> None:
    scene = step.cloud(500, "cloud")
    model = simulator_of("gausim_paper", scene, step.levels_of(scene, (60, 8)), *step.QUICK.network)
    coarse, fine = (level.count for level in model.batch([0]).levels)
    assert fine == pytest.approx(60, abs=2) and coarse == pytest.approx(8, abs=1)
    assert 0 < int(scene.pinned.sum()) < 50
