"""The cases of `gausim benchmark`: which figures they report, and that these fit together."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

from gausim.benchmark import cluster, interact, render, step, train
from gausim.benchmark.harness import Options
from gausim.benchmark.splats import splats
from gausim.cli.benchmark import simulator_of
from gausim.core import GaussianScene
from gausim.data.curriculum import Curriculum
from gausim.data.datamodule import ReadyDataModule
from gausim.losses import Objective
from gausim.models.initial_state import ModalInitialStates
from gausim.models.template.elastic import ElasticTemplate
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule

QUICK = Options(torch.device("cpu"), quick=True, rounds=1)


def test_every_size_of_the_clustering_has_its_count_and_its_speed() -> None:
    rows = cluster.run(QUICK)
    found = {(row.case, row.metric): row.value for row in rows}
    for count in cluster.SIZES[True]:
        case = f"{count} kernels"
        assert found[case, "clusters ratio"] == 1.0 and found[case, "time ratio"] > 0
        assert 0 < found[case, "clusters"] < count
    assert len(found) == len(rows)


def test_the_stages_of_a_frame() -> None:
    rows = interact.run(QUICK, simulator_of)
    (case,) = {row.case for row in rows}
    found = {row.metric: row.value for row in rows}
    assert case.startswith("300 kernels") and len(found) == len(rows)
    assert all(math.isfinite(value) and value >= 0 for value in found.values())
    assert found["simulated"] == pytest.approx(1 / found["step"])
    assert found["made one after the other"] < found["simulated"]
    assert all(found[name] > 0 for name in ("step", "colours", "packing"))


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


def _module(scenes: list[GaussianScene]) -> GausSimModule:
    template = partial(ElasticTemplate, modes=6, neighbours=6)
    options = {"radii": (0.3, 0.7), "edges": "rest", "hidden": 8, "layers": 1, "zero_output": True}
    model = gausim(scenes, [24.0], template=template, **options)
    return GausSimModule(
        method=SharedSimulator(model, ModalInitialStates(model, (0, 0)), (0, 0)),
        renderer=CpuRenderer(threads=1), objective=Objective(),
    )  # fmt: skip


def test_rows_of_the_training_benchmark(tmp_path: Path) -> None:
    toy = toy_object.write_toy_object(tmp_path / "toy", frames=8)
    data = ReadyDataModule(toy.root, curriculum=Curriculum(t_max=3), batch_size=2)
    scenes = [item.scene() for item in data.objects]
    module, other = (_module(scenes) for _ in range(2))
    before = {name: value.detach().clone() for name, value in module.named_parameters()}
    rows = train.run(QUICK, module, data, {"model=other": other})
    found = {(row.metric, row.reference): row.value for row in rows}
    assert {row.case for row in rows} == {"toy: 2 sequences x 2 views x 32x32, T=3"}
    metrics = {row.metric for row in rows}
    assert {"throughput / model=other", "throughput / plain", "held for the backward pass, at most", "rest"} <= metrics
    assert sum(row.value for row in rows if row.unit == "1") == pytest.approx(1.0)
    assert found["throughput", None] == pytest.approx(6e3 / found["optimiser step", None])
    assert all(row.value > 0 for row in rows if row.unit in ("x", "ms", "MiB") and "further" not in row.metric)
    assert all(torch.equal(before[name], value) for name, value in module.named_parameters())
    assert module.renderer.__class__ is CpuRenderer and module.objective.static_probability is None


@pytest.mark.slow
@pytest.mark.parametrize("first_call", [False, True])
def test_every_figure_of_the_renderer_is_reported(first_call: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """New processes import everything and compile, which takes half a minute; the rest is quick."""
    monkeypatch.setattr(render, "SHORT_CALLS", 0.0)
    monkeypatch.setattr(render, "QUICK_CASES", ((100, 20), (150, 24)))
    if not first_call:
        monkeypatch.setattr(render, "in_fresh_process", lambda count, size, cache: 1.0)
    rows = render.run(QUICK)
    found = {(row.case, row.metric): row.value for row in rows}
    assert len(found) == len(rows) and all(value > 0 for value in found.values())
    for count, size in render.QUICK_CASES:
        name = f"render, {count} kernels, {size} x {size}"
        for metric in ("forward", "forward + backward"):
            ratio = found[name, f"{metric}, plain torch"] / found[name, metric]
            assert found[name, f"plain torch / {metric}"] == pytest.approx(ratio)
    threads = [case for case, metric in found if metric == "one thread / two threads"]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert len(threads) == (4 if cores and cores > 1 else 0)
    assert [metric for case, metric in found if case.startswith("first call")] == ["compiles", "cached"]


def test_a_gpu_that_cannot_be_used_is_reported(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(gsplat, "unavailable", lambda: "gsplat is not installed")
    assert render.run(Options(torch.device("cuda"), quick=True)) == []
    assert "not measured, because gsplat is not installed" in capsys.readouterr().err


def test_both_sides_of_every_ratio_compute_the_same() -> None:
    scene = splats(200, 33, 25, views=2)
    images = [scene.forward(renderer) for renderer in (CpuRenderer(threads=1), ReferenceRenderer())]
    assert images[0].rgb.shape == (1, 2, 25, 33, 3) and float(images[0].alpha.max()) > 0.5
    torch.testing.assert_close(images[0].rgb, images[1].rgb, atol=1e-3, rtol=0)  # thresholds fall differently
    found, expected = (scene.both(renderer, scene.weights()) for renderer in (CpuRenderer(), ReferenceRenderer()))
    for value, truth in zip(found, expected, strict=True):
        assert float((value - truth).norm() / truth.norm()) < 1e-2
