"""Rendering: the CPU renderer against plain torch in tiles and the processor's peak; threads, compilation, memory."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from gausim.benchmark.first_call import in_fresh_process
from gausim.benchmark.harness import Options, Row, medians, torch_threads
from gausim.benchmark.peaks import fma_peak, peaks
from gausim.benchmark.render_stages import Stages
from gausim.benchmark.splats import Deformed, Splats, deformed, splats
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer
from gausim.render.cpu.raster import BACKWARD_FLOPS, FORWARD_FLOPS
from gausim.render.draw import deformed_appearance
from gausim.render.reference import ReferenceRenderer

# Kernels and edge of the square image [pixels].
CASES = tuple((count, size) for count in (5_000, 23_000) for size in (128, 256, 512))
QUICK_CASES = ((300, 40), (500, 64), (500, 72))
PAPER = (23_422, 960, 540)  # kernels, width and height of the paper's scene
VIEWS = 4
UNITS, SH_DEGREE = 1_203, 3
TORCH = "render=reference: plain torch in tiles, float32, one thread, same run"
FMA = "the processor's fused multiply-add peak, same run; operations of raster.py x pixels evaluated"
# Short calls are timed several in a row: in training, too, a call of the renderer follows others.
SHORT_CALLS = 0.02  # [s]


def run(options: Options) -> list[Row]:
    """Figures of the CPU renderer or, where the device is a GPU, of gsplat's."""
    if options.device.type == "cuda":
        return _gsplat(options)
    cases = QUICK_CASES if options.quick else CASES
    rows: list[Row] = []
    with torch_threads(1):
        for count, size in cases:
            scene, name = splats(count, size, size), _name(count, size)
            rows += _against_torch(name, scene, options) + _parts(name, scene, options)
        rows += _threads(cases, options) + _appearance(cases[-1][0], options)
    return rows + _first_call(*cases[-1])


def _name(count: int, size: int) -> str:
    return f"render, {count} kernels, {size} x {size}"


def _against_torch(name: str, scene: Splats, options: Options) -> list[Row]:
    """Forward alone and forward with all gradients, one thread, against plain torch."""
    cpu, reference, weights = CpuRenderer(threads=1), ReferenceRenderer(), scene.weights()
    calls: dict[str, Callable[[], object]] = {
        "forward": partial(scene.forward, cpu),
        "forward + backward": partial(scene.both, cpu, weights),
        "forward, torch": partial(scene.forward, reference),
        "forward + backward, torch": partial(scene.both, reference, weights),
    }
    times = _in_a_row(calls, options)
    rows = []
    for metric in ("forward", "forward + backward"):
        slow = times[f"{metric}, torch"]
        rows.append(Row(name, metric, 1e3 * times[metric], "ms"))
        rows.append(Row(name, f"{metric}, plain torch", 1e3 * slow, "ms", "render=reference"))
        rows.append(Row(name, f"plain torch / {metric}", slow / times[metric], "x", TORCH))
    return rows


def _parts(name: str, scene: Splats, options: Options) -> list[Row]:
    """The parts of an image, each repeated alone on its warm arrays, and what the hot loops reach of the peak."""
    stages = Stages(scene)
    times = _in_a_row(stages.parts, options)
    rows = [Row(name, part, 1e3 * seconds, "ms") for part, seconds in times.items()]
    evaluated, peak = stages.evaluated(), peaks(options).fma
    work = {"compositing": FORWARD_FLOPS * evaluated, "compositing, backward": BACKWARD_FLOPS * evaluated}
    for part, flops in work.items():
        rows.append(Row(name, f"{part} / peak", flops / times[part] / peak, "1", FMA))
    both = sum(work.values()) / sum(times[part] for part in work)
    rows.append(Row(name, "compositing, both / peak", both / peak, "1", FMA))
    return rows


def _threads(cases: tuple[tuple[int, int], ...], options: Options) -> list[Row]:
    """Two threads against one, for one view and for several views in one call."""
    if len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)) < 2:
        print("render: this process has one core; two threads are not measured.", file=sys.stderr)
        return []
    count, sizes = cases[-1][0], [size for _, size in cases[-2:]]
    scenes = {_name(count, size): splats(count, size, size) for size in sizes}
    scenes |= {f"{_name(count, size)}, {VIEWS} views": splats(count, size, size, VIEWS) for size in sizes}
    limit = fma_peak(2) / fma_peak(1)
    text = f"one thread, same run, forward + backward; two threads' peak of fused multiply-adds is {limit:.2f} x one's"
    rows = []
    for name, scene in scenes.items():
        weights = scene.weights()
        calls = {str(n): partial(scene.both, CpuRenderer(threads=n), weights) for n in (1, 2)}
        times = _in_a_row(calls, options, rounds=3 * options.rounds)
        if scene.viewmats.shape[1] > 1:
            rows.append(Row(name, "forward + backward, one call", 1e3 * times["1"], "ms"))
        rows.append(Row(name, "one thread / two threads", times["1"] / times["2"], "x", text))
    return rows


def _appearance(count: int, options: Options) -> list[Row]:
    """Colours and covariances of deformed kernels, which every image starts from."""
    state = deformed(count, UNITS, VIEWS, SH_DEGREE)
    name = f"colours and covariances, {count} kernels, {VIEWS} views, degree {SH_DEGREE}"
    rows = []
    for metric, call in (("forward", _forward), ("forward + backward", _gradients)):
        times = _in_a_row(
            {
                "cpu": partial(call, state, deformed_appearance.fast),
                "torch": partial(call, state, deformed_appearance.plain),
            },
            options,
        )
        rows.append(Row(name, metric, 1e3 * times["cpu"], "ms"))
        text = "the torch form, one thread, same run"
        rows.append(Row(name, f"plain torch / {metric}", times["torch"] / times["cpu"], "x", text))
    return rows


_Form = Callable[..., tuple[Tensor, Tensor]]


@torch.no_grad()
def _forward(state: Deformed, form: _Form) -> object:
    return form(*state[:4], state.look.covars, state.look.sh, state.centers)


def _gradients(state: Deformed, form: _Form) -> tuple[Tensor, ...]:
    leaves = [value.detach().requires_grad_() for value in state[:3]]
    outputs = form(*leaves, state.unit_of_kernel, state.look.covars, state.look.sh, state.centers)
    return torch.autograd.grad(outputs, leaves, [torch.ones_like(output) for output in outputs])


def _first_call(count: int, size: int) -> list[Row]:
    """First calls in new processes: with an empty cache of compiled code, then with a filled one."""
    rows, name = [], f"first call, {count} kernels, {size} x {size}"
    with tempfile.TemporaryDirectory() as cache:
        for state in ("compiles", "cached"):
            found = in_fresh_process(count, size, cache)
            text = "forward + backward in a new process, beyond its imports"
            rows.append(Row(name, f"renderer, {state}", found["renderer"], "s", text))
            rows.append(Row(name, f"colours and covariances, {state}", found["appearance"], "s", text))
    rows.append(Row(name, "process memory", found["memory"], "B", "largest resident set, one image forward + backward"))
    rows.append(Row(name, "process memory, imports alone", found["imports"], "B", "before the first call"))
    return rows


def _gsplat(options: Options) -> list[Row]:
    """The paper's scene on the GPU."""
    reason = gsplat.unavailable()
    if reason is not None:
        print(f"render on {options.device}: not measured, because {reason}.", file=sys.stderr)
        return []
    count, width, height = (500, 64, 48) if options.quick else PAPER
    scene = splats(count, width, height, VIEWS).to(options.device)
    renderer, weights = gsplat.GsplatRenderer(), scene.weights()
    calls: dict[str, Callable[[], object]] = {
        "forward": partial(scene.forward, renderer),
        "forward + backward": partial(scene.both, renderer, weights),
    }
    torch.cuda.reset_peak_memory_stats(options.device)
    times = medians(calls, options, warmup=3)
    name = f"gsplat, {count} kernels, {VIEWS} views {width} x {height}"
    rows = [Row(name, metric, 1e3 * seconds, "ms") for metric, seconds in times.items()]
    return [*rows, Row(name, "device memory", float(torch.cuda.max_memory_allocated(options.device)), "B", "largest")]


def _in_a_row(
    calls: Mapping[str, Callable[[], object]], options: Options, *, rounds: int | None = None
) -> dict[str, float]:
    """Medians of the calls [s], as :func:`medians`, each repeated until about SHORT_CALLS seconds have gone."""
    repeats = {}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        repeats[name] = max(1, int(SHORT_CALLS / (time.perf_counter() - start)))

    def several(name: str) -> None:
        for _ in range(repeats[name]):
            calls[name]()

    times = medians({name: partial(several, name) for name in calls}, options, rounds=rounds)
    return {name: seconds / repeats[name] for name, seconds in times.items()}
