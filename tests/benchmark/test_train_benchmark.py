from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

from gausim.benchmark.harness import Options
from gausim.benchmark.train import run
from gausim.core import GaussianScene
from gausim.data.curriculum import Curriculum
from gausim.data.datamodule import ReadyDataModule
from gausim.losses import Objective
from gausim.models.initial_state import ModalInitialStates
from gausim.models.template.elastic import ElasticTemplate
from gausim.render.cpu import CpuRenderer
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule


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
    rows = run(Options(torch.device("cpu"), quick=True, rounds=1), module, data, {"model=other": other})
    found = {(row.metric, row.reference): row.value for row in rows}
    assert {row.case for row in rows} == {"toy: 2 sequences x 2 views x 32x32, T=3"}
    metrics = {row.metric for row in rows}
    assert {"throughput / model=other", "throughput / plain", "held for the backward pass, at most", "rest"} <= metrics
    assert sum(row.value for row in rows if row.unit == "1") == pytest.approx(1.0)
    assert found["throughput", None] == pytest.approx(6e3 / found["optimiser step", None])
    assert all(row.value > 0 for row in rows if row.unit in ("x", "ms", "MiB") and "further" not in row.metric)
    assert all(torch.equal(before[name], value) for name, value in module.named_parameters())
    assert module.renderer.__class__ is CpuRenderer and module.objective.static_probability is None
