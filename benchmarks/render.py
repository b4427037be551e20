"""Rendering: the CPU renderer against plain torch; threads, views and compilation; on a GPU gsplat.

``python -m benchmarks.render COUNT SIZE`` prints the seconds of the first call in its process.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.harness import Options, Row, medians, seconds_of
from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import Rendered, Renderer
from gausim.ops.covariance import covariance_from_scales
from gausim.render.cpu import CpuRenderer
from gausim.render.gsplat import GsplatRenderer

# Kernels and edge of the square image [pixels].
CASES = {False: [(n, size) for n in (5_000, 23_000) for size in (128, 256, 512)], True: [(100, 20), (150, 24)]}
PAPER = (23_422, 960, 540)  # kernels, width and height of the paper's scene
VIEWS = 4
TORCH = "plain torch in tiles, one thread"
SHORT_CALLS = 0.02  # [s]; shorter calls are timed several in a row, as in training


class Splats(NamedTuple):
    """One state in V views: the arguments of a renderer."""

    means: Tensor  # (1, K, 3)
    covars: Tensor  # (1, K, 3, 3)
    colors: Tensor  # (1, V, K, 3)
    opacities: Tensor  # (1, K)
    viewmats: Tensor  # (1, V, 4, 4)
    Ks: Tensor  # (1, V, 3, 3)
    size: tuple[int, int]

    @torch.no_grad()
    def forward(self, renderer: Renderer) -> Rendered:
        """Renders without a graph."""
        return renderer(*self, background=self.means.new_tensor([0.1, 0.5, 0.9]))

    def both(self, renderer: Renderer) -> tuple[Tensor, ...]:
        """Gradients of a weighted sum of the images with respect to the first four fields."""
        means, covars, colors, opacities = leaves = [field.detach().requires_grad_() for field in self[:4]]
        behind = self.means.new_tensor([0.1, 0.5, 0.9])
        rgb = renderer(means, covars, colors, opacities, *self[4:], background=behind).rgb
        return torch.autograd.grad([rgb], leaves, [_weights(rgb.shape).to(rgb)])


@cache
def _weights(shape: torch.Size) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(1))


def splats(count: int, width: int, height: int, views: int = 1, device: torch.device | str = "cpu") -> Splats:
    """A cloud of ``count`` kernels that covers about the same fraction of an image for any count; cameras around it."""
    g = torch.Generator().manual_seed(0)
    log_scales = 0.5 * torch.randn(1, count, 3, generator=g) + math.log(0.5 / count**0.5)
    cos, sin = (f(0.7 * torch.arange(views, dtype=torch.float32)) for f in (torch.cos, torch.sin))
    viewmats = torch.eye(4).repeat(1, views, 1, 1)
    viewmats[0, :, 0, 0], viewmats[0, :, 0, 2], viewmats[0, :, 2, 0], viewmats[0, :, 2, 2] = cos, sin, -sin, cos
    viewmats[0, :, 2, 3] = 2.5
    focal = 1.2 * width
    intrinsics = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    means, covars, colors, opacities, viewmats, intrinsics = (
        tensor.to(device)
        for tensor in (
            0.4 * torch.randn(1, count, 3, generator=g),
            covariance_from_scales(log_scales, torch.randn(1, count, 4, generator=g)),
            torch.rand(1, views, count, 3, generator=g),
            torch.rand(1, count, generator=g),
            viewmats,
            intrinsics.repeat(1, views, 1, 1),
        )
    )
    return Splats(means, covars, colors, opacities, viewmats, intrinsics, (width, height))


def run(options: Options) -> list[Row]:
    """Figures of the CPU renderer or, on a GPU, of gsplat."""
    if options.device.type == "cuda":
        count, width, height = (500, 64, 48) if options.quick else PAPER
        scene = splats(count, width, height, VIEWS, options.device)
        return _times(f"gsplat, {count} kernels, {VIEWS} views {width} x {height}", scene, GsplatRenderer(), options)
    rows: list[Row] = []
    for count, size in CASES[options.quick]:
        rows += _times(f"render, {count} kernels, {size} x {size}", splats(count, size, size), None, options)
    return rows + _threads(*CASES[options.quick][-1], options) + _first_call(*CASES[options.quick][-1])


def _times(case: str, scene: Splats, renderer: Renderer | None, options: Options) -> list[Row]:
    """Forward pass, and forward and backward pass; of the CPU renderer (None) against plain torch."""
    rows = []
    renderers: dict[str, Renderer] = (
        {"own": renderer} if renderer else {"own": CpuRenderer(threads=1), "torch": ReferenceRenderer()}
    )
    for metric, call in (("forward", Splats.forward), ("forward + backward", Splats.both)):
        calls = {name: partial(call, scene, one) for name, one in renderers.items()}
        times = medians(calls, options, warmup=2, at_least=0.0 if options.quick else SHORT_CALLS)
        rows.append(Row(case, metric, 1e3 * times["own"], "ms"))
        if "torch" in times:
            rows.append(Row(case, f"plain torch / {metric}", times["torch"] / times["own"], "x", TORCH))
    return rows


def _threads(count: int, size: int, options: Options) -> list[Row]:
    """Two threads against one, for one view and for several in one call; none where there is one core."""
    rows = []
    for views in (1, VIEWS) if (os.cpu_count() or 1) > 1 else ():
        scene = splats(count, size, size, views)
        times = medians({str(n): partial(scene.both, CpuRenderer(threads=n)) for n in (1, 2)}, options, warmup=2)
        case = f"render, {count} kernels, {size} x {size}, {views} views"
        rows.append(Row(case, "one thread / two threads", times["1"] / times["2"], "x", "forward + backward"))
    return rows


def _first_call(count: int, size: int) -> list[Row]:
    """First calls in new processes, with an empty and with a filled cache of compiled code."""
    command = [sys.executable, "-m", "benchmarks.render", str(count), str(size)]
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        for state in ("compiles", "cached"):
            environment = os.environ | {"NUMBA_CACHE_DIR": cache}
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            case = f"first call, {count} kernels, {size} x {size}"
            rows.append(Row(case, state, float(done.stdout), "s", "forward + backward, beyond the imports"))
    return rows


if __name__ == "__main__":
    torch.set_num_threads(1)
    one = torch.ones(2, requires_grad=True)
    torch.autograd.grad([2 * one], [one], [torch.ones(2)])  # torch imports more when it first differentiates
    scene = splats(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[2]))
    print(seconds_of(lambda: scene.both(CpuRenderer(threads=1)), torch.device("cpu")))
