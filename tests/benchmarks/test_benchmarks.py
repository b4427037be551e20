"""Every case of the benchmarks at tiny sizes: figures exist, are finite, and ratios fit the times."""

import math
import subprocess
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

from benchmarks import cluster, data, endurance, interact, render, scale, step, teach, train
from benchmarks.harness import Options, peak_saved_bytes
from gausim.core import GaussianScene
from gausim.data.datamodule import ReadyDataModule
from gausim.losses import Objective
from gausim.models.initial_state import ModalInitialStates
from gausim.models.template.material import MaterialTemplate
from gausim.render.cpu import CpuRenderer
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


def _module(scenes: list[GaussianScene]) -> GausSimModule:
    template = partial(MaterialTemplate, modes=6)
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


def test_the_whole_of_a_training_is_the_sum_of_its_stages(tmp_path: Path) -> None:
    toy = toy_object.write_toy_object(tmp_path / "toy", frames=8)
    plan = TrainingPlan(t_start=1, t_max=3, batch_size=2, epochs=2)
    items = ReadyDataModule(toy.root, plan=plan)
    rows = scale.measure(QUICK, _module([item.scene() for item in items.objects]), items, plan)
    found = {row.metric: row for row in rows}
    assert found["training"].case == "30 sequences, 2 epochs of 4 uses"
    assert found["training"].value == pytest.approx(sum(found[stage].value for stage in ("tracking", "fit", "images")))
    assert found["images"].value == pytest.approx(240 * found["optimiser step, per sequence"].value / 3600)


def test_peak_counts_what_is_held_at_one_time() -> None:
    x = torch.rand(1000, requires_grad=True)

    def in_turn() -> None:
        for _ in range(5):
            x.exp().sum().backward()

    assert peak_saved_bytes(in_turn) == 4000  # the result of exp, once
    assert peak_saved_bytes(lambda: (x.exp().sum() + x.sin().exp().sum()).backward()) == 3 * 4000
    assert peak_saved_bytes(lambda: (x * x).sum()) == 4000  # x twice, the same storage


def test_teaching_is_measured_in_pairs() -> None:
    rows = {row.metric: row for row in teach.run(QUICK)}
    assert {(row.unit, row.value > 0) for row in rows.values()} == {("pairs/s", True), ("frames/s", True)}
    assert next(iter(rows.values())).case.startswith("teach, 120 kernels, ")


def test_endurance_of_a_run(played: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endurance, "PUSHED_FRAMES", 20)
    played.module.method = SimpleNamespace(hands=lambda sequence: None)
    (item,) = endurance.run_objects(played)
    found = endurance.endurance(item, 60)
    assert len(found["free"]["energy"]) == 3 and found["free"]["energy"][-1] < found["free"]["energy"][0]
    assert found["pushed"]["away"][0] > 0 and found["pushed"]["peak"] < 60
