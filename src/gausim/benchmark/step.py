"""Benchmark of one predicted frame without rendering: the paper's simulator with and without hierarchy, and others."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gausim.benchmark.harness import Options, Row, medians, peak_saved_bytes, process_memory, torch_threads
from gausim.core import GaussianScene, SimState
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.step.simulator import GausSim

CLUSTERING = "agglomerative"
# Edge lengths of the two levels, coarse to fine, and of the kernels without hierarchy [fractions of the diagonal].
EDGE_LENGTHS, KERNEL_LEVEL = (2.0, 0.4), "hierarchy.levels=[{diameter:0.0,edge_length:0.1}]"
# Timed calls of slow candidates; here, too, the first call is not timed.
LONG_ROUNDS = 2
PAPER_RATIO = "with hierarchy, same run (the paper: 2.8 in time, 1.7 in memory, rendering included)"
# Makes the untrained simulator of ``conf/model/PRESET.yaml`` for a scene: build(preset, scene, *settings), settings
# KEY=VALUE of it. The command passes it in, because it composes the configurations.
Build = Callable[..., GausSim]


@dataclass(frozen=True)
class Size:
    """Size of the scene; by default the paper's."""

    kernels: int = 23_422
    units: tuple[int, int] = (1_203, 11)  # of levels 1 and 2
    network: tuple[str, ...] = ()  # settings


QUICK = Size(400, (40, 6), ("network.hidden=16", "network.layers=2"))


def run(options: Options, build: Build) -> list[Row]:
    """Times and memory of the paper's simulator, with the scene's hierarchy and with every kernel predicted.

    Then those of the neural simulator beside the elastic model's, each with its own hierarchy and network.
    """
    size = QUICK if options.quick else Size()
    with torch_threads(options.threads):
        scene = cloud(size.kernels, "paper")
        return [*_frame(scene, size, options, build), *_neural(scene, options, build)]


def cloud(count: int, name: str, *, degree: int = 1) -> GaussianScene:
    """Kernels uniform in an ellipsoid with axes 0.8, 0.6 and 1, the lowest twentieth pinned.

    Their colours are spherical harmonics of degree ``degree``.
    """
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 3, generator=generator)
    x = x / x.norm(dim=1, keepdim=True) * torch.rand(count, 1, generator=generator) ** (1 / 3)
    means = x * torch.tensor([0.4, 0.3, 0.5])
    return GaussianScene.create(
        means=means,
        log_scales=torch.full((count, 3), -4.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.zeros(count),
        sh=0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
        pinned=means[:, 2] < means[:, 2].quantile(0.05),
        name=name,
    )


def levels_of(scene: GaussianScene, units: Sequence[int]) -> str:
    """Setting of levels with about ``units`` units, fine to coarse; diameters are found by bisection."""
    found: tuple[float, ...] = ()
    for wanted in units:
        low, high = 0.0, 1.0
        for _ in range(14):
            middle = 0.5 * (low + high)
            count = build_hierarchy(scene, radii=(*found, middle), clustering=CLUSTERING).levels[-1].count
            if count == wanted:
                break
            low, high = (middle, high) if count > wanted else (low, middle)
        found = (*found, middle)
    pairs = zip(reversed(found), EDGE_LENGTHS, strict=True)
    return f"hierarchy.levels=[{','.join(f'{{diameter:{d},edge_length:{length}}}' for d, length in pairs)}]"


def _neural(scene: GaussianScene, options: Options, build: Build) -> list[Row]:
    rows, found = [], dict[str, dict[str, float]]()
    for preset in ("gausim_elastic", "gausim"):
        bound = Bound(build(preset, scene), options)
        case = f"step, {scene.count} kernels, {bound.units} units, {preset}"
        times = medians({"forward": bound.forward, "forward + backward": bound.both}, options)
        found[preset] = times | {"kept for the backward pass": float(peak_saved_bytes(bound.differentiable))}
        for metric, value in found[preset].items():
            shown = (1e3 * value, "ms") if metric in times else (value / 2**20, "MiB")
            rows.append(Row(case, metric, *shown))
    elastic, neural = found.values()
    note = "a training prepares its matrices once for all frames of a rollout"
    return rows + [Row(case, f"{m} / elastic", neural[m] / elastic[m], "x", note) for m in neural]


def _frame(scene: GaussianScene, size: Size, options: Options, build: Build) -> list[Row]:
    bound = Bound(build("gausim_paper", scene, levels_of(scene, size.units), *size.network), options)
    case = f"step, {size.kernels} kernels, {bound.units} units"
    times = medians({"forward": bound.forward, "forward + backward": bound.both}, options)
    kept = float(peak_saved_bytes(bound.differentiable))
    rows = [Row(case, "edges", float(bound.edges), "1")]
    rows += [Row(case, metric, 1e3 * seconds, "ms") for metric, seconds in times.items()]
    rows.append(Row(case, "kept for the backward pass", kept / 2**20, "MiB"))

    flat = Bound(build("gausim_paper", scene, KERNEL_LEVEL, *size.network), options)
    case, rounds = f"step, {size.kernels} kernels, no hierarchy", min(options.rounds, LONG_ROUNDS)

    def beside(metric: str, value: float, unit: str, reference: float) -> list[Row]:
        ratio = Row(case, f"{metric} / with hierarchy", value / reference, "x", PAPER_RATIO)
        return [Row(case, metric, value * (1e3 if unit == "ms" else 2**-20), unit), ratio]

    def timed(metric: str, call: Callable[[], None]) -> list[Row]:
        return beside(metric, medians({"": call}, options, rounds=rounds)[""], "ms", times[metric])

    rows += [Row(case, "edges", float(flat.edges), "1"), *timed("forward", flat.forward)]
    needed = 1.5 * kept * flat.edges / bound.edges
    if needed > _available_memory(options.device):
        print(f"step: about {needed / 2**30:.0f} GiB are not free, so {case} has no backward pass.", file=sys.stderr)
        return rows
    rows += timed("forward + backward", flat.both)
    return rows + beside("kept for the backward pass", float(peak_saved_bytes(flat.differentiable)), "MiB", kept)


def _available_memory(device: torch.device) -> int:
    """Memory available without swapping [bytes]."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return process_memory("MemAvailable", "/proc/meminfo") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _bent(batch: SceneBatch, amount: float) -> Tensor:
    """Positions (K, 3) of the batch's scenes bent sideways, so that some neighbours differ from those at rest."""
    height = batch.rest[:, 2] - batch.rest[:, 2].min()
    bent = batch.rest + torch.stack((amount * height**2, torch.zeros_like(height), torch.zeros_like(height)), 1)
    return torch.where((batch.inherited < 0)[:, None], batch.rest, bent)


class Bound:
    """A simulator with random weights and its scene in motion; the methods are timed."""

    def __init__(self, model: GausSim, options: Options) -> None:
        self.model = model.to(options.device)
        self.batch: SceneBatch = model.batch((0,))
        self.state = SimState(*(_bent(self.batch, amount) for amount in (0.3, 0.29)))
        self.edges = self._edges()
        self.units = " + ".join(str(level.count) for level in reversed(self.batch.levels))

    def _edges(self) -> int:
        """Edges that the network sees, of all levels."""
        seen: list[int] = []
        network = self.model.predictor.network
        handle = network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2].shape[1]))
        self.forward()
        handle.remove()
        return sum(seen[-len(self.batch.levels) :])  # after those of the anchor, if there is one

    def differentiable(self) -> Tensor:
        """The step with a graph from the initial state and the parameters; returns a scalar to differentiate."""
        state = SimState(self.state.positions, self.state.previous.clone().requires_grad_())
        step = self.model.step(self.batch, state, None, self.model.prepare(self.batch))
        return sum((x.sum() for x in (step.positions, step.deformation_gradients, step.rotations)), step.momentum)

    def both(self) -> None:
        """Forward and backward pass, with the input statistics."""
        self.model.train().zero_grad()
        self.differentiable().backward()

    @torch.no_grad()
    def forward(self) -> None:
        """Forward pass without a graph."""
        self.model.eval()
        self.model.step(self.batch, self.state, None, self.model.prepare(self.batch))
