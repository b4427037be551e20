"""One predicted frame without rendering: the paper's simulator with and without hierarchy, and the other models."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.harness import Options, Row, cloud, medians, peak_saved_bytes, simulator_of
from gausim.core import GaussianScene, SimState
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.step.simulator import GausSim
from gausim.runs.cost import process_memory

# Kernels, units of levels 1 and 2, settings of the network: the paper's, and a quick one.
SIZES = {
    False: (23_422, (1_203, 11), ()),
    True: (120, (24, 4), ("network.hidden=16", "network.layers=2")),
}
# Edge lengths of the levels, coarse to fine, and the level of kernels without hierarchy [fractions of the diagonal].
EDGE_LENGTHS, KERNEL_LEVEL = (2.0, 0.4), "hierarchy.levels=[{diameter:0.0,edge_length:0.1}]"
MODELS = ("gausim_network", "gausim")
PAPER_RATIO = "with hierarchy (the paper: 2.8 in time, 1.7 in memory, rendering included)"


def run(options: Options) -> list[Row]:
    """Times and memory with the scene's hierarchy and with every kernel predicted, then of the other models."""
    kernels, units, network = SIZES[options.quick]
    scene = cloud(kernels)
    levels = {"with hierarchy": levels_of(scene, units), "no hierarchy": KERNEL_LEVEL}
    papers = {name: simulator_of("gausim_paper", scene, level, *network) for name, level in levels.items()}
    models = {name: simulator_of(name, scene) for name in MODELS}
    few = replace(options, rounds=min(options.rounds, 2))  # a step of all kernels takes half a minute
    return [*_beside(papers, PAPER_RATIO, few), *_beside(models, MODELS[0], options)]


def levels_of(scene: GaussianScene, units: Sequence[int]) -> str:
    """Setting of levels with about ``units`` units, fine to coarse; diameters are found by bisection."""
    found: tuple[float, ...] = ()
    for wanted in units:
        low, high = 0.0, 1.0
        for _ in range(14):
            middle = 0.5 * (low + high)
            count = build_hierarchy(scene, radii=(*found, middle)).levels[-1].count
            if count == wanted:
                break
            low, high = (middle, high) if count > wanted else (low, middle)
        found = (*found, middle)
    pairs = zip(reversed(found), EDGE_LENGTHS, strict=True)
    return f"hierarchy.levels=[{','.join(f'{{diameter:{d},edge_length:{length}}}' for d, length in pairs)}]"


def _beside(models: dict[str, GausSim], reference: str, options: Options) -> list[Row]:
    """Figures of each model, and the second's over the first's; no backward pass where memory is too small."""
    bound = {name: _Bound(model, options) for name, model in models.items()}
    first, second = models
    forward = medians({name: one.forward for name, one in bound.items()}, options)
    kept = {first: float(peak_saved_bytes(bound[first].differentiable))}
    needed = 1.5 * kept[first] * bound[second].edges / bound[first].edges
    if needed > _free_memory(options.device):
        print(
            f"step: about {needed / 2**30:.0f} GiB are not free, so '{second}' has no backward pass.", file=sys.stderr
        )
    else:
        kept[second] = float(peak_saved_bytes(bound[second].differentiable))
    both = medians({name: bound[name].both for name in kept}, options)
    figures = {"forward": (forward, 1e3, "ms"), "forward + backward": (both, 1e3, "ms")}
    figures["kept for the backward pass"] = kept, 2**-20, "MiB"
    rows = []
    for name, one in bound.items():
        case = f"step, {one.kernels} kernels, {one.units} units, {name}"
        rows.append(Row(case, "edges", one.edges, "1"))
        for metric, (values, scale, unit) in figures.items():
            rows += [Row(case, metric, scale * values[name], unit)] if name in values else []
            if name == second and second in values:
                rows.append(Row(case, f"{metric} / {first}", values[second] / values[first], "x", reference))
    return rows


def _free_memory(device: torch.device) -> int:
    """Memory available without swapping [bytes]."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return process_memory("MemAvailable", "/proc/meminfo") or sys.maxsize


class _Bound:
    """A simulator with random weights and its scene in motion; the methods are timed."""

    def __init__(self, model: GausSim, options: Options) -> None:
        self.model = model.to(options.device)
        self.batch = model.batch((0,))
        rest = self.batch.rest
        height = torch.where(self.batch.inherited < 0, 0.0, rest[:, 2] - rest[:, 2].min())
        bend = torch.stack((height**2, torch.zeros_like(height), torch.zeros_like(height)), 1)
        self.state = SimState(rest + 0.3 * bend, rest + 0.29 * bend)
        self.kernels = len(rest)
        self.units = " + ".join(str(level.count) for level in reversed(self.batch.levels))
        seen: list[int] = []  # edges that the network sees
        network = self.model.predictor.network
        handle = network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2].shape[1]))
        self.forward()
        handle.remove()
        self.edges = sum(seen[-len(self.batch.levels) :])  # after those of the anchor, if there is one

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
