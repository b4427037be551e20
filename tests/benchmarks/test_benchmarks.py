"""Every case of the benchmarks at tiny sizes: figures exist, are finite, and ratios fit the times."""

from __future__ import annotations

import json
import math
import subprocess
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

from benchmarks import __main__ as command
from benchmarks import bodies, cluster, data, interact, render, step, train
from benchmarks.harness import Options, Row, cloud, medians, peak_saved_bytes, simulator_of
from gausim.core import GaussianScene
from gausim.data.datamodule import ReadyDataModule
from gausim.losses import Objective
from gausim.models.initial_state import ModalInitialStates
from gausim.models.template.elastic import ElasticTemplate
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.plan import TrainingPlan

QUICK = Options(quick=True, rounds=1)


@pytest.fixture
def first_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first call in a new process imports and compiles everything, which takes half a minute."""
    done = subprocess.CompletedProcess([], 0, stdout="1.0")
    monkeypatch.setattr(render.subprocess, "run", lambda *args, **options: done)


@pytest.mark.parametrize("case", [cluster, data, interact, render, step])
def test_every_case_gives_finite_figures(case, first_call: None) -> None:
    torch.manual_seed(0)
    rows = case.run(QUICK)
    assert rows and all(math.isfinite(row.value) and row.value >= 0 for row in rows)
    found = {(row.case, row.metric, row.unit): row.value for row in rows}
    assert len(found) == len(rows)
    assert any(row.reference for row in rows) or case is interact


def test_ratios_are_of_the_times_beside_them() -> None:
    rows = step.run(QUICK)
    flat = next(row.case for row in rows if "no hierarchy" in row.case)
    found = {(row.case, row.metric): row.value for row in rows}
    paper = next(row.case for row in rows if "with hierarchy" in row.case)
    for metric in ("forward", "forward + backward", "kept for the backward pass"):
        assert found[flat, f"{metric} / with hierarchy"] == pytest.approx(found[flat, metric] / found[paper, metric])


def test_levels_have_the_units_wanted() -> None:
    scene = cloud(500)
    model = simulator_of("gausim_paper", scene, step.levels_of(scene, (60, 8)), *step.SIZES[True][2])
    coarse, fine = (level.count for level in model.batch([0]).levels)
    assert fine == pytest.approx(60, abs=2) and coarse == pytest.approx(8, abs=1)


def _module(scenes: list[GaussianScene]) -> GausSimModule:
    template = partial(ElasticTemplate, modes=6, neighbours=6)
    model = gausim(scenes, [24.0], template=template, radii=(0.3, 0.7), edges="rest", hidden=8, layers=1)
    method = SharedSimulator(model, ModalInitialStates(model, (0, 0)), (0, 0))
    return GausSimModule(method=method, renderer=CpuRenderer(threads=1), objective=Objective())


def test_training_is_measured_and_leaves_the_weights(tmp_path: Path) -> None:
    toy = toy_object.write_toy_object(tmp_path / "toy", frames=8)
    items = ReadyDataModule(toy.root, plan=TrainingPlan(t_start=1, t_max=3, batch_size=2))
    module, other = (_module([item.scene() for item in items.objects]) for _ in range(2))
    before = {name: value.detach().clone() for name, value in module.named_parameters()}
    rows = train.measure(QUICK, module, items, {"model=other": other})
    found = {row.metric: row.value for row in rows}
    assert {row.case for row in rows} == {"toy: 2 sequences x 2 views x 32x32, T=3"}
    assert {"throughput / model=other", "throughput / plain", "held for the backward pass, at most"} <= set(found)
    assert found["throughput"] == pytest.approx(6e3 / found["optimiser step"])
    assert all(torch.equal(before[name], value) for name, value in module.named_parameters())


def test_both_sides_of_a_renderers_ratio_compute_the_same() -> None:
    scene = render.splats(200, 33, 25, views=2)
    found, expected = (scene.both(renderer) for renderer in (CpuRenderer(), ReferenceRenderer()))
    for value, truth in zip(found, expected, strict=True):
        assert float((value - truth).norm() / truth.norm()) < 1e-2


def test_candidates_are_called_in_turn_after_a_warm_up() -> None:
    calls: list[str] = []
    result = medians({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, Options(rounds=3), warmup=2)
    assert calls == ["a", "b"] * 5 and set(result) == {"a", "b"}


def test_peak_counts_what_is_held_at_one_time() -> None:
    x = torch.rand(1000, requires_grad=True)

    def in_turn() -> None:
        for _ in range(5):
            x.exp().sum().backward()

    assert peak_saved_bytes(in_turn) == 4000  # the result of exp, once
    assert peak_saved_bytes(lambda: (x.exp().sum() + x.sin().exp().sum()).backward()) == 3 * 4000
    assert peak_saved_bytes(lambda: (x * x).sum()) == 4000  # x twice, the same storage


def test_the_command_prints_one_object(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(cluster, "run", lambda options: [Row("2k kernels", "ratio", 3.0, "x", "scipy")])
    assert command.main(["cluster", "--json", "--quick", "--rounds", "1"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"machine", "rows"} and document["rows"][0]["value"] == 3.0


def test_errors_of_fits_are_drawn_by_the_bodies_of_their_base(tmp_path: Path, capsys) -> None:
    for number, (count, error) in enumerate(((0, 0.9), (10, 0.5), (10, 0.7))):
        (tmp_path / str(number)).mkdir()
        facts = {"seen": 6, "pretrained": count, "all": {"error": [0.1, 0.2, error]}}
        (tmp_path / str(number) / bodies.FILE).write_text(json.dumps(facts))
    assert bodies.main([str(tmp_path), str(tmp_path / "curve.png")]) == 0
    assert "6 frames seen: 0.900 with 0 bodies, 0.600 with 10 bodies" in capsys.readouterr().out
    assert (tmp_path / "curve.png").stat().st_size > 1000
