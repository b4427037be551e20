"""Benchmark of one predicted frame without rendering, with and without hierarchy, and of a training batch's steps."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gausim.benchmark.harness import (
    Options,
    Row,
    medians,
    peak_saved_bytes,
    plainly,
    process_memory,
    spent_in,
    torch_threads,
)
from gausim.core import GaussianScene, SimState
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.step import predictor, simulator
from gausim.models.step.prepared import Prepared
from gausim.models.step.simulator import GausSim
from gausim.models.template.template import PreparedTemplate
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.normaliser import RunningNormaliser

CLUSTERING = "agglomerative"
# Edge lengths of the two levels, coarse to fine, and of the kernels without hierarchy [fractions of the diagonal].
EDGE_LENGTHS, KERNEL_LEVEL = (2.0, 0.4), "hierarchy.levels=[{diameter:0.0,edge_length:0.1}]"
# Timed calls of slow candidates; here, too, the first call is not timed.
LONG_ROUNDS = 2
PAPER_RATIO = "with hierarchy, same run (the paper: 2.8 in time, 1.7 in memory, rendering included)"
# References of the neural simulator's speed.
ELASTIC, PLAIN = "model=gausim_elastic, same run", "the same steps by the plain forms of all operations"

# Makes the untrained simulator of ``conf/model/PRESET.yaml`` for a scene: build(preset, scene, *settings), settings
# KEY=VALUE of it. The command passes it in, because it composes the configurations.
Build = Callable[..., GausSim]


@dataclass(frozen=True)
class Size:
    """Sizes of the cases; the defaults are the paper's scene and a training batch of the bunny."""

    kernels: int = 23_422
    units: tuple[int, int] = (1_203, 11)  # of levels 1 and 2
    batch: int = 4  # sequences of the training batch
    bunny: int = 1_999
    bunny_units: tuple[int, int] = (144, 15)
    steps: int = 15  # predicted frames of the training batch
    network: tuple[str, ...] = ()  # settings


QUICK = Size(400, (40, 6), 2, 300, (30, 5), 2, ("network.hidden=16", "network.layers=2"))


def run(options: Options, build: Build) -> list[Row]:
    """Times, fractions outside the network, parts and memory, for the sizes of :class:`Size`."""
    size = QUICK if options.quick else Size()
    with torch_threads(options.threads):
        return [*_paper(size, options, build), *_training(size, options, build)]


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


def parts(template: PreparedTemplate) -> Mapping[str, Sequence[tuple[Any, str]]]:
    """Functions of the parts of a step, for :func:`gausim.benchmark.harness.spent_in`."""
    kind = type(template)
    return {
        "aggregation": [(Prepared, "aggregate"), (Prepared, "per_level")],
        "template": [(kind, "carried"), (kind, "__call__")],
        "edges": [(predictor, "exact_edges")],
        "features": [(predictor, "network_inputs")],
        "normalisers": [(RunningNormaliser, "forward")],
        "network": [(MeshGraphNet, "forward")],
        "recursion and kernels": [
            (predictor.DeformationPredictor, "deformation_gradient"), (simulator, "advance"), (simulator, "inherit"),
        ],
    }  # fmt: skip


def _paper(size: Size, options: Options, build: Build) -> list[Row]:
    """The paper's scene, with its hierarchy and with every kernel predicted."""
    scene = cloud(size.kernels, "paper")
    bound = Bound(build("gausim_paper", scene, levels_of(scene, size.units), *size.network), 1, options)
    case = f"step, {size.kernels} kernels, {bound.units} units"
    forward = medians({"step": bound.forward, "network": bound.network_forward}, options)
    both = medians({"step": bound.both, "network": bound.network_both}, options)
    kept = float(peak_saved_bytes(bound.differentiable))
    rows = [Row(case, "edges", float(bound.edges), "1"), *_outside(case, "forward", forward)]
    rows += [*_outside(case, "forward + backward", both), Row(case, "kept for the backward pass", kept / 2**20, "MiB")]
    rows += [Row(case, f"forward, {name}", 1e3 * t, "ms") for name, t in bound.parts(options).items()]

    flat = Bound(build("gausim_paper", scene, KERNEL_LEVEL, *size.network), 1, options)
    case, rounds = f"step, {size.kernels} kernels, no hierarchy", min(options.rounds, LONG_ROUNDS)

    def beside(metric: str, value: float, unit: str, reference: float) -> list[Row]:
        ratio = Row(case, f"{metric} / with hierarchy", value / reference, "x", PAPER_RATIO)
        return [Row(case, metric, value * (1e3 if unit == "ms" else 2**-20), unit), ratio]

    rows.append(Row(case, "edges", float(flat.edges), "1"))
    rows += beside("forward", medians({"": flat.forward}, options, rounds=rounds)[""], "ms", forward["step"])
    needed = 1.5 * kept * flat.edges / bound.edges
    if needed > _available_memory(options.device):
        print(f"step: about {needed / 2**30:.0f} GiB are not free, so {case} has no backward pass.", file=sys.stderr)
        return rows
    rows += beside("forward + backward", medians({"": flat.both}, options, rounds=rounds)[""], "ms", both["step"])
    return rows + beside("kept for the backward pass", float(peak_saved_bytes(flat.differentiable)), "MiB", kept)


def _training(size: Size, options: Options, build: Build) -> list[Row]:
    """All steps of a training batch of the neural simulator, against the elastic one and the plain forms."""
    scene = cloud(size.bunny, "bunny")
    levels = levels_of(scene, size.bunny_units)
    bound, elastic = (
        Bound(build(preset, scene, levels, *size.network), size.batch, options, steps=size.steps)
        for preset in ("gausim", "gausim_elastic")
    )
    case = f"{size.steps} steps, {size.batch} x {size.bunny} kernels, {bound.units} units"
    rows = [Row(case, "edges", float(bound.edges), "1")]
    for metric, call, alone, other in (
        ("forward", bound.forward, bound.network_forward, elastic.forward),
        ("forward + backward", bound.both, bound.network_both, elastic.both),
    ):
        times = medians({"step": call, "network": alone, "elastic": other, "plain": plainly(call)}, options)
        rows += _outside(case, metric, {**times, "network": size.steps * times["network"]})
        rows += [
            Row(case, f"{metric}, throughput", size.steps * size.batch / times["step"], "sequence-steps/s"),
            Row(case, f"{metric}, throughput / elastic", times["elastic"] / times["step"], "x", ELASTIC),
            Row(case, f"{metric}, throughput / plain", times["plain"] / times["step"], "x", PLAIN),
        ]
    return [*rows, Row(case, "kept for the backward pass", peak_saved_bytes(bound.differentiable) / 2**20, "MiB")]


def _outside(case: str, metric: str, times: dict[str, float]) -> list[Row]:
    outside = 1 - times["network"] / times["step"]
    return [
        Row(case, metric, 1e3 * times["step"], "ms"),
        Row(case, f"{metric}, outside the network", outside, "1", "the whole step; the network alone, same run"),
    ]


def _available_memory(device: torch.device) -> int:
    """Memory available without swapping [bytes]."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return process_memory("MemAvailable", "/proc/meminfo") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _bent(batch: SceneBatch, amount: float) -> Tensor:
    """Positions (K, 3) of the batch's scenes bent sideways, so that some neighbours differ from those at rest."""
    height = batch.rest[:, 2] - batch.rest[:, 2].min()
    bent = batch.rest + torch.stack((amount * height**2, torch.zeros_like(height), torch.zeros_like(height)), 1)
    return torch.where((batch.kernels.unit < 0)[:, None], batch.rest, bent)


class Bound:
    """A simulator with random weights and a batch of its scene in motion; the methods are timed."""

    def __init__(self, model: GausSim, members: int, options: Options, *, steps: int = 1) -> None:
        self.model, self.steps = model.to(options.device), steps
        self.batch: SceneBatch = model.batch((0,) * members)
        self.state = SimState(*(_bent(self.batch, amount) for amount in (0.3, 0.29)))
        self._inputs = self._seen_by_the_network()
        self.edges = sum(inputs[2].shape[1] for inputs in self._inputs)
        self.units = " + ".join(str(level.count) for level in reversed(self.batch.levels))

    def _seen_by_the_network(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        seen: list[tuple[Tensor, Tensor, Tensor]] = []
        handle = self.model.predictor.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
        with torch.no_grad():
            self.model.eval().step(self.batch, self.state)
        handle.remove()
        return seen[-len(self.batch.levels) :]  # after those of the anchor, if there is one

    def differentiable(self) -> Tensor:
        """All steps with a graph from the initial state and the parameters; returns a scalar to differentiate."""
        state = SimState(self.state.positions, self.state.previous.clone().requires_grad_())
        prepared, total = self.model.prepare(self.batch), self.batch.rest.new_zeros(())
        for _ in range(self.steps):
            step = self.model.step(self.batch, state, None, prepared)
            state = SimState(step.positions, state.positions)
            total = total + sum(x.sum() for x in (step.positions, step.deformation_gradients, step.rotations))
            total = total + step.momentum
        return total

    def both(self) -> None:
        """Forward and backward pass, with the input statistics."""
        self.model.train().zero_grad()
        self.differentiable().backward()

    @torch.no_grad()
    def forward(self) -> None:
        """Forward pass without a graph."""
        self.model.eval()
        prepared, state = self.model.prepare(self.batch), self.state
        for _ in range(self.steps):
            state = SimState(self.model.step(self.batch, state, None, prepared).positions, state.positions)

    @torch.no_grad()
    def network_forward(self) -> None:
        """Forward pass of one step's network alone."""
        for inputs in self._inputs:
            self.model.predictor.network(*inputs)

    def network_both(self) -> None:
        """Forward and backward pass of one step's network alone, to its inputs and weights."""
        self.model.zero_grad()
        network = self.model.predictor.network
        differentiable = [(n.clone().requires_grad_(), e.clone().requires_grad_(), i) for n, e, i in self._inputs]
        torch.cat([network(*inputs) for inputs in differentiable]).sum().backward()

    @torch.no_grad()
    def parts(self, options: Options) -> dict[str, float]:
        """Times of the parts of a forward step and of the stretch's preparation [s]."""
        self.model.eval()
        constants = medians({"constants": lambda: self.model.prepare(self.batch)}, options)
        prepared = self.model.prepare(self.batch)
        with spent_in(parts(prepared.template), options.device) as seconds:
            for _ in range(options.rounds):
                self.model.step(self.batch, self.state, None, prepared)
        return constants | {name: spent / options.rounds for name, spent in seconds.items()}
