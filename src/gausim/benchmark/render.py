"""Benchmark of rendering: CPU renderer against plain torch; threads, views and compilation."""

from __future__ import annotations

import itertools
import os
import sys
import tempfile
from functools import partial

import torch

from gausim.benchmark.first_call import in_fresh_process
from gausim.benchmark.harness import Options, Row, medians, torch_threads
from gausim.benchmark.splats import Splats, splats
from gausim.core import Renderer
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer

# Kernels and edge of the square image [pixels].
CASES = tuple((count, size) for count in (5_000, 23_000) for size in (128, 256, 512))
QUICK_CASES = ((300, 40), (500, 64), (500, 72))
PAPER = (23_422, 960, 540)  # kernels, width and height of the paper's scene
VIEWS = 4
TORCH = "render=reference: plain torch in tiles, float32, one thread, same run"
# Calls shorter than this are timed several in a row, as in training, where a call of the renderer follows others.
SHORT_CALLS = 0.02  # [s]


def run(options: Options) -> list[Row]:
    """Figures of the CPU renderer or, on a GPU, of gsplat."""
    if options.device.type == "cuda":
        return _gsplat(options)
    cases = QUICK_CASES if options.quick else CASES
    rows: list[Row] = []
    with torch_threads(1):
        for count, size in cases:
            scene, name = splats(count, size, size), _name(count, size)
            rows += _against_torch(name, scene, options)
        rows += _threads(cases, options)
    return rows + _first_call(*cases[-1])


def _name(count: int, size: int, measured: str = "render") -> str:
    return f"{measured}, {count} kernels, {size} x {size}"


def _against_torch(name: str, scene: Splats, options: Options) -> list[Row]:
    """Forward pass, and forward and backward pass, with one thread, against plain torch."""
    rows, weights = [], scene.weights()
    renderers: dict[str, Renderer] = {"own": CpuRenderer(threads=1), "torch": ReferenceRenderer()}
    for metric, call in (("forward", Splats.forward), ("forward + backward", partial(Splats.both, weights=weights))):
        times = medians(
            {name: partial(call, scene, renderer) for name, renderer in renderers.items()},
            options, warmup=2, at_least=SHORT_CALLS,
        )  # fmt: skip
        rows.append(Row(name, metric, 1e3 * times["own"], "ms"))
        rows.append(Row(name, f"{metric}, plain torch", 1e3 * times["torch"], "ms", "render=reference"))
        rows.append(Row(name, f"plain torch / {metric}", times["torch"] / times["own"], "x", TORCH))
    return rows


def _threads(cases: tuple[tuple[int, int], ...], options: Options) -> list[Row]:
    """Two threads against one, for one view and for several in one call."""
    if len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)) < 2:
        print("render: this process has one core; two threads are not measured.", file=sys.stderr)
        return []
    rows = []
    for views, (_, size) in itertools.product((1, VIEWS), cases[-2:]):
        count = cases[-1][0]
        scene = splats(count, size, size, views)
        name = _name(count, size) + (f", {views} views" if views > 1 else "")
        calls = {str(n): partial(scene.both, CpuRenderer(threads=n), scene.weights()) for n in (1, 2)}
        times = medians(calls, options, rounds=3 * options.rounds, warmup=2, at_least=SHORT_CALLS)
        if views > 1:
            rows.append(Row(name, "forward + backward, one call", 1e3 * times["1"], "ms"))
        rows.append(Row(name, "one thread / two threads", times["1"] / times["2"], "x", "same run, forward + backward"))
    return rows


def _first_call(count: int, size: int) -> list[Row]:
    """First calls in new processes, with an empty and with a filled cache of compiled code."""
    name, text = _name(count, size, "first call"), "forward + backward in a new process, beyond its imports"
    with tempfile.TemporaryDirectory() as cache:
        return [Row(name, s, in_fresh_process(count, size, cache), "s", text) for s in ("compiles", "cached")]


def _gsplat(options: Options) -> list[Row]:
    """The paper's scene on the GPU."""
    reason = gsplat.unavailable()
    if reason is not None:
        print(f"render on {options.device}: not measured, because {reason}.", file=sys.stderr)
        return []
    count, width, height = (500, 64, 48) if options.quick else PAPER
    scene, renderer = splats(count, width, height, VIEWS).to(options.device), gsplat.GsplatRenderer()
    torch.cuda.reset_peak_memory_stats(options.device)
    times = medians(
        {
            "forward": partial(scene.forward, renderer),
            "forward + backward": partial(scene.both, renderer, scene.weights()),
        },
        options,
        warmup=3,
    )
    name = f"gsplat, {count} kernels, {VIEWS} views {width} x {height}"
    rows = [Row(name, metric, 1e3 * seconds, "ms") for metric, seconds in times.items()]
    return [*rows, Row(name, "device memory", float(torch.cuda.max_memory_allocated(options.device)), "B", "largest")]
