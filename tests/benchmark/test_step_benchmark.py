from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from gausim.benchmark import step
from gausim.benchmark.harness import Options
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
    ("file", "settings"),
    [
        ("gausim_paper", step.PAPER),
        ("gausim", {**step.DEFAULT, "template": step.TEMPLATE}),
        ("gausim_elastic", {**step.ELASTIC, "template": step.ELASTIC_TEMPLATE}),
    ],
)
def test_settings_are_those_of_the_configuration(file, settings) -> None:
    text = (Path(__file__).parents[2] / f"conf/model/{file}.yaml").read_text()
    simulator = yaml.safe_load(text)["simulator"]
    for name, value in settings.items():
        expected = simulator[name]
        if isinstance(value, dict):
            expected = {key: expected[key] for key in value}
        assert (list(value) if isinstance(value, tuple) else value) == expected, name
    ablation = yaml.safe_load((Path(__file__).parents[2] / "conf/ablation/no_hierarchy.yaml").read_text())
    for name, value in ablation["model"]["simulator"].items():
        assert list(step.NO_HIERARCHY[name]) == value
