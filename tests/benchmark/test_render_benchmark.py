from __future__ import annotations

import os

import pytest
import torch

from gausim.benchmark import render
from gausim.benchmark.harness import Options
from gausim.benchmark.splats import splats
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer

QUICK = Options(torch.device("cpu"), quick=True, rounds=1)


@pytest.mark.slow
@pytest.mark.parametrize("first_call", [False, True])
def test_every_figure_is_reported(first_call: bool, monkeypatch: pytest.MonkeyPatch) -> None:
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
