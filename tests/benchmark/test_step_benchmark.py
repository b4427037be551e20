from __future__ import annotations

import pytest
import torch

from gausim.benchmark import step
from gausim.benchmark.harness import Options
from gausim.compose.config import compose, instantiate
from gausim.models.hierarchy.clusters import build_hierarchy


@pytest.mark.slow
def test_every_figure_of_the_step_is_reported() -> None:
    torch.manual_seed(0)
    rows = step.run(Options(torch.device("cpu"), quick=True, rounds=1))
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
    assert len(parts) == 9 and all(found[paper, metric] >= 0 for metric in parts[1:])


def test_no_backward_pass_where_memory_would_not_do(monkeypatch, capsys) -> None:
    monkeypatch.setattr(step, "_available_memory", lambda device: 0)
    rows = step.run(Options(torch.device("cpu"), quick=True, rounds=1))
    assert "has no backward pass" in capsys.readouterr().err
    flat = [row.metric for row in rows if row.case.endswith("no hierarchy")]
    assert flat == ["edges", "forward", "forward / with hierarchy"]


def test_radii_are_found_that_give_the_units_wanted() -> None:
    scene = step.cloud(500, "cloud")
    radii = step.find_radii(scene, (60, 8))
    levels = build_hierarchy(scene, radii=radii, clustering=step.CLUSTERING).levels
    assert levels[1].count == pytest.approx(60, abs=2) and levels[2].count == pytest.approx(8, abs=1)
    assert 0 < int(scene.pinned.sum()) < 50


@pytest.mark.parametrize(
    ("file", "settings", "template"),
    [
        ("gausim_paper", step.PAPER, {}),
        ("gausim", step.DEFAULT, step.TEMPLATE),
        ("gausim_elastic", step.ELASTIC, step.ELASTIC_TEMPLATE),
    ],
)
def test_settings_are_those_of_the_configuration(file, settings, template) -> None:
    config = compose(f"model/{file}").model.simulator
    made = step.simulator(step.cloud(300, "toy"), 24.0, (0.13, 0.4), settings)
    configured = instantiate(config, scenes=made.scenes, fps=[24.0])()
    assert [h.levels[-1].count for h in made.hierarchies] == [h.levels[-1].count for h in configured.hierarchies]
    assert made.predictor.features == configured.predictor.features and made.predictor.head == configured.predictor.head
    assert made.rollout == configured.rollout and vars(made.predictor.edges) == vars(configured.predictor.edges)
    shapes = [{n: tuple(p.shape) for n, p in m.predictor.named_parameters()} for m in (made, configured)]
    assert shapes[0] == shapes[1]
    assert template == {key: config.template[key] for key in template}
