from __future__ import annotations

import pytest
import torch

from gausim.benchmark import step
from gausim.benchmark.harness import Options
from gausim.cli.benchmark import simulator_of

QUICK = Options(torch.device("cpu"), quick=True, rounds=1)


@pytest.mark.parametrize("memory", [1 << 40, pytest.param(0, marks=pytest.mark.slow)])
def test_every_figure_of_the_step_is_reported(memory: int, monkeypatch, capsys) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(step, "_available_memory", lambda device: memory)
    monkeypatch.setattr(step, "QUICK", step.Size(120, (24, 4), step.QUICK.network))
    rows = step.run(QUICK, simulator_of)
    found = {(row.case, row.metric): row.value for row in rows}
    assert len(found) == len(rows)
    paper, flat, elastic, neural = list(dict.fromkeys(row.case for row in rows))
    assert paper.startswith("step, 120 kernels") and flat.endswith("no hierarchy")
    assert all(found[paper, metric] > 0 for metric in ("forward", "forward + backward"))
    assert found[flat, "edges"] > found[paper, "edges"] > 0
    assert elastic.endswith(" units, gausim_elastic") and neural.endswith(" units, gausim")
    times = [found[case, "forward + backward"] for case in (neural, elastic)]
    assert found[neural, "forward + backward / elastic"] == pytest.approx(times[0] / times[1])
    said = capsys.readouterr().err
    for metric in ("forward + backward", "kept for the backward pass"):
        assert ((flat, f"{metric} / with hierarchy") in found) == bool(memory) == ("no backward pass" not in said)


def test_levels_are_found_that_have_the_units_wanted() -> None:
    scene = step.cloud(500, "cloud")
    model = simulator_of("gausim_paper", scene, step.levels_of(scene, (60, 8)), *step.QUICK.network)
    coarse, fine = (level.count for level in model.batch([0]).levels)
    assert fine == pytest.approx(60, abs=2) and coarse == pytest.approx(8, abs=1)
    assert 0 < int(scene.pinned.sum()) < 50
