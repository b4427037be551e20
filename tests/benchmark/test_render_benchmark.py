from __future__ import annotations

import itertools
import os

import numpy as np
import pytest
import torch

from gausim.benchmark import render
from gausim.benchmark.first_call import in_fresh_process
from gausim.benchmark.harness import Options, Row
from gausim.benchmark.render_stages import Stages
from gausim.benchmark.splats import deformed, splats
from gausim.cli.benchmark import CASES
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import deformed_appearance
from gausim.render.reference import ReferenceRenderer

QUICK = Options(torch.device("cpu"), quick=True, rounds=1)


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch, tmp_path) -> list[Row]:
    """A quick run whose new processes find this process's compiled code."""
    import numba

    monkeypatch.setattr(
        render, "in_fresh_process", lambda count, size, cache: in_fresh_process(count, size, numba.config.CACHE_DIR)
    )
    monkeypatch.setattr(render, "SHORT_CALLS", 0.0)
    return render.run(QUICK)


def test_every_figure_is_reported(rows: list[Row]) -> None:
    found = {(row.case, row.metric): row.value for row in rows}
    assert len(found) == len(rows) and all(value > 0 for value in found.values())
    for count, size in render.QUICK_CASES:
        name = f"render, {count} kernels, {size} x {size}"
        for metric in ("forward", "forward + backward"):
            ratio = found[name, f"{metric}, plain torch"] / found[name, metric]
            assert found[name, f"plain torch / {metric}"] == pytest.approx(ratio)
        for metric in ("compositing / peak", "compositing, backward / peak"):
            assert found[name, metric] < 1
    threads = [case for case, metric in found if metric == "one thread / two threads"]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert len(threads) == (4 if cores and cores > 1 else 0)
    first = [metric for case, metric in found if case.startswith("first call")]
    assert len(first) == 6 and "renderer, compiles" in first and "colours and covariances, cached" in first
    assert any(case.startswith("colours and covariances") for case, _ in found)


def test_one_core_has_no_rows_about_threads(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0}, raising=False)
    assert render._threads(render.QUICK_CASES, QUICK) == []
    assert "two threads are not measured" in capsys.readouterr().err


def test_a_gpu_that_cannot_be_used_is_reported(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(gsplat, "unavailable", lambda: "gsplat is not installed")
    assert render.run(Options(torch.device("cuda"), quick=True)) == []
    assert "not measured, because gsplat is not installed" in capsys.readouterr().err


def test_both_renderers_draw_and_differentiate_the_same_scene() -> None:
    scene = splats(200, 33, 25, views=2)
    images = [scene.forward(renderer) for renderer in (CpuRenderer(threads=1), ReferenceRenderer())]
    assert images[0].rgb.shape == (1, 2, 25, 33, 3) and float(images[0].alpha.max()) > 0.5
    torch.testing.assert_close(images[0].rgb, images[1].rgb, atol=1e-3, rtol=0)  # thresholds fall differently
    found, expected = (scene.both(renderer, scene.weights()) for renderer in (CpuRenderer(), ReferenceRenderer()))
    assert [x.shape for x in found] == [x.shape for x in scene[:5]]
    for value, truth in zip(found, expected, strict=True):
        assert float((value - truth).norm() / truth.norm()) < 1e-2


def test_colours_of_both_forms_are_the_same() -> None:
    state = deformed(50, 6, 3, 2)
    fast, plain = deformed_appearance.fast, deformed_appearance.plain
    for value, expected in zip(render._forward(state, fast), render._forward(state, plain), strict=True):
        torch.testing.assert_close(value, expected)
    found, truth = render._gradients(state, fast), render._gradients(state, plain)
    for value, expected in zip(found, truth, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-4, atol=1e-5)


def test_pixels_are_counted_as_by_hand() -> None:
    """Every block of two rows of eight pixels evaluates the kernels that reach it, until its last pixel closes."""
    stages = Stages(splats(60, 40, 48))
    evaluated = 0
    for band in stages.bands:
        for tile, p in itertools.product(range(len(band.start) - 1), range(8)):
            entries = band.entries[band.start[tile] : band.start[tile + 1]]
            reaching = [packed for packed in entries if (packed >> 4) & 15 <= p <= packed & 15]
            evaluated += 16 * len(reaching[: band.used[tile, p]])
    assert stages.evaluated() == evaluated > 0


def test_the_parts_can_be_repeated_and_draw_the_image() -> None:
    scene = splats(200, 33, 25)
    stages = Stages(scene)
    before = stages.images.rgb.copy()
    for part in stages.parts.values():
        part()
    assert np.array_equal(stages.images.rgb, before)
    assert np.array_equal(before, scene.forward(CpuRenderer(threads=1)).rgb.numpy())


def test_the_command_has_every_case() -> None:
    import importlib

    for name in CASES:
        assert callable(importlib.import_module(f"gausim.benchmark.{name}").run)
