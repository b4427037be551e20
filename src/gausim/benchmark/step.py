"""One predicted frame without rendering, with and without hierarchy and part by part; the steps of a training batch."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gausim.benchmark.harness import Options, Row, medians, saved_bytes, torch_threads
from gausim.core import GaussianScene, SimState
from gausim.kernels.operations import plain_forms
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.rollout.cuda_graph import GraphedStep
from gausim.models.settings import HierarchySettings, RolloutSettings
from gausim.models.step.features import FeatureOptions, network_inputs
from gausim.models.step.head import Head
from gausim.models.step.prepared import Prepared
from gausim.models.step.recursion import Solved, Units, advance, inherit
from gausim.models.step.simulator import GausSim
from gausim.models.template.elastic import ElasticTemplate
from gausim.models.template.material import MaterialTemplate
from gausim.models.template.template import Motion, RestTemplate, Template
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.ops.deformation import gradient_from_output

CLUSTERING = "agglomerative"
# The simulators of conf/model/gausim_paper.yaml, of conf/ablation/no_hierarchy.yaml with it, of gausim.yaml and of
# gausim_elastic.yaml: their parts as far as these are not the constructors' defaults. Diameters are found by count.
Settings = dict[str, Any]
PAPER: Settings = {"network": {"hidden": 128, "layers": 16, "norm": "joint"}}
DEFAULT: Settings = {
    "hierarchy": {"max_neighbours": 8, "edges": "rest", "body_frame": True},
    "features": {"rest_inputs": True, "velocities": False, "attributes": 8},
    "network": {"hidden": 48, "layers": 3},
    "head": {"output_scale": 0.1, "zero_output": True, "lever": 0.02, "anchor": True},
    "rollout": {"energy_guard_frames": 36},
}
TEMPLATE: Settings = {"modes": 48, "spacing": 0.12, "links": 12, "hidden": 48, "period": 8.0, "damping": 0.02}
ELASTIC: Settings = {
    "hierarchy": {"max_neighbours": 8, "edges": "rest"},
    "features": {"rest_inputs": True},
    "network": {"hidden": 32, "layers": 2},
    "head": {"output_scale": 0.01, "zero_output": True},
    "rollout": {"energy_guard_frames": 12},
}
EDGE_LENGTHS, KERNEL_EDGE_LENGTH = (2.0, 0.4), 0.1
ELASTIC_TEMPLATE: Settings = {
    "modes": 48, "solid": 0.12, "geometric": 1.0, "neighbours": 24, "period": 8.0, "amplitude": 0.02,
}  # fmt: skip
# Calls of what takes long; its first call is not timed either.
LONG_ROUNDS = 2
PAPER_RATIO = "with hierarchy, same run (the paper: 2.8 in time, 1.7 in memory, rendering included)"


@dataclass(frozen=True)
class Size:
    """How large the cases are; the defaults are the paper's scene and a training batch of the bunny.

    Attributes:
        kernels: of the paper's scene.
        units: its systems of levels 1 and 2.
        batch: sequences of the training batch.
        bunny: kernels of its scene.
        bunny_units: and systems of levels 1 and 2.
        steps: predicted frames of the training batch.
        network: overrides the width and number of layers.
    """

    kernels: int = 23_422
    units: tuple[int, int] = (1_203, 11)
    batch: int = 4
    bunny: int = 1_999
    bunny_units: tuple[int, int] = (144, 15)
    steps: int = 15
    network: tuple[tuple[str, int], ...] = ()


QUICK = Size(400, (40, 6), 2, 300, (30, 5), 2, (("hidden", 16), ("layers", 2)))


def run(options: Options) -> list[Row]:
    """Times, shares outside the network, parts and memory; sizes are those of :class:`Size`."""
    size = QUICK if options.quick else Size()
    with torch_threads(options.threads):
        return [*_paper(size, options), *_training(size, options)]


def cloud(count: int, name: str) -> GaussianScene:
    """Kernels spread evenly through an ellipsoid with axes 0.8, 0.6 and 1, the lowest twentieth pinned."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 3, generator=generator)
    x = x / x.norm(dim=1, keepdim=True) * torch.rand(count, 1, generator=generator) ** (1 / 3)
    means = x * torch.tensor([0.4, 0.3, 0.5])
    return GaussianScene.create(
        means=means,
        log_scales=torch.full((count, 3), -4.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 4, 3),
        simulated=torch.ones(count, dtype=torch.bool),
        pinned=means[:, 2] < means[:, 2].quantile(0.05),
        name=name,
    )


def find_radii(scene: GaussianScene, units: Sequence[int]) -> tuple[float, ...]:
    """Cluster diameters [diagonals] at which the levels have about so many units, found by bisection."""
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
    return found


def simulator(
    scene: GaussianScene,
    fps: float,
    diameters: Sequence[float],
    settings: Settings,
    *,
    network: Mapping[str, int] | None = None,
    template: Callable[..., Template] = RestTemplate,
) -> GausSim:
    """A simulator with the settings of a configuration.

    Args:
        scene: what it simulates.
        fps: its frame rate.
        diameters: of its units, fine to coarse [diagonals]; none is without hierarchy.
        settings: by part.
        network: overrides of the network's.
        template: what it deforms.
    """
    lengths = EDGE_LENGTHS if diameters else (KERNEL_EDGE_LENGTH,)
    levels = [
        {"diameter": diameter, "edge_length": length}
        for diameter, length in zip(tuple(reversed(diameters)) or (0.0,), lengths, strict=True)
    ]
    return GausSim(
        [scene],
        [fps],
        hierarchy=HierarchySettings(levels=levels, clustering=CLUSTERING, **settings.get("hierarchy", {})),
        features=FeatureOptions(**settings.get("features", {})),
        network=functools.partial(MeshGraphNet, **{**settings["network"], **(network or {})}),
        head=Head(**settings.get("head", {})),
        rollout=RolloutSettings(**settings.get("rollout", {})),
        template=template,
    )


def _paper(size: Size, options: Options) -> list[Row]:
    scene = cloud(size.kernels, "paper")
    radii = find_radii(scene, size.units)
    network = dict(size.network)
    bound = Bound(simulator(scene, 24.0, radii, PAPER, network=network), 1, options)
    counts = " + ".join(str(level.count) for level in reversed(bound.batch.levels))
    case = f"step, {size.kernels} kernels, {counts} units"
    rows = [Row(case, "edges", float(bound.edges()), "1")]
    calls: dict[str, Callable[[], object]] = {"step": bound.forward, "network": bound.network_forward}
    if options.device.type == "cuda":
        calls["graph"] = bound.replay()
    forward = medians(calls, options)
    both = medians({"step": bound.both, "network": bound.network_both}, options)
    rows += _shares(case, "forward", forward) + _shares(case, "forward + backward", both)
    if "graph" in forward:
        rows.append(Row(case, "forward, CUDA graph", 1e3 * forward["graph"], "ms"))
    kept = float(saved_bytes(bound.differentiable))
    rows.append(Row(case, "kept for the backward pass", kept / 2**20, "MiB"))
    rows += [Row(case, f"forward, {name}", 1e3 * t, "ms") for name, t in medians(bound.parts(), options).items()]
    without = simulator(scene, 24.0, (), PAPER, network=network)
    return rows + _without(Bound(without, 1, options), bound, forward["step"], both["step"], kept, size, options)


def _without(
    flat: Bound, bound: Bound, forward: float, both: float, kept: float, size: Size, options: Options
) -> list[Row]:
    """The same scene with every kernel predicted."""
    case = f"step, {size.kernels} kernels, no hierarchy"
    rows, rounds = [Row(case, "edges", float(flat.edges()), "1")], min(options.rounds, LONG_ROUNDS)
    slow = medians({"step": flat.forward}, options, rounds=rounds)["step"]
    rows.append(Row(case, "forward", 1e3 * slow, "ms"))
    rows.append(Row(case, "forward / with hierarchy", slow / forward, "x", PAPER_RATIO))
    needed = 1.5 * kept * flat.edges() / bound.edges()
    if needed > _available_memory(options.device):
        print(f"step: about {needed / 2**30:.0f} GiB are not free, so {case} has no backward pass.", file=sys.stderr)
        return rows
    slow = medians({"step": flat.both}, options, rounds=rounds)["step"]
    rows.append(Row(case, "forward + backward", 1e3 * slow, "ms"))
    rows.append(Row(case, "forward + backward / with hierarchy", slow / both, "x", PAPER_RATIO))
    most = float(saved_bytes(flat.differentiable))
    rows.append(Row(case, "kept for the backward pass", most / 2**20, "MiB"))
    rows.append(Row(case, "kept for the backward pass / with hierarchy", most / kept, "x", PAPER_RATIO))
    return rows


def _training(size: Size, options: Options) -> list[Row]:
    """All steps of a training batch, compiled and by torch alone, and against those of the elastic model."""
    scene = cloud(size.bunny, "bunny")
    radii = find_radii(scene, size.bunny_units)

    def bind(settings: dict[str, Any], template: Callable[..., Template]) -> Bound:
        model = simulator(scene, 24.0, radii, settings, network=dict(size.network), template=template)
        return Bound(model, size.batch, options, steps=size.steps)

    bound = bind(DEFAULT, functools.partial(MaterialTemplate, **TEMPLATE))
    elastic = bind(ELASTIC, functools.partial(ElasticTemplate, **ELASTIC_TEMPLATE))
    counts = " + ".join(str(level.count) for level in reversed(bound.batch.levels))
    case = f"{size.steps} steps, {size.batch} x {size.bunny} kernels, {counts} units"
    rows = [Row(case, "edges", float(bound.edges()), "1")]
    for metric, call, alone, other in (
        ("forward", bound.forward, bound.network_forward, elastic.forward),
        ("forward + backward", bound.both, bound.network_both, elastic.both),
    ):
        by_torch = functools.partial(_by_torch, call)
        times = medians({"step": call, "network": alone, "torch": by_torch, "elastic": other}, options)
        rows += _shares(case, metric, {**times, "network": size.steps * times["network"]})
        reference = "the torch forms of the same operations, same run"
        rows.append(Row(case, f"{metric} / torch forms", times["step"] / times["torch"], "x", reference))
        reference = "model=gausim_elastic, same run"
        rows.append(Row(case, f"{metric} / elastic", times["step"] / times["elastic"], "x", reference))
    rows.append(Row(case, "kept for the backward pass", saved_bytes(bound.differentiable) / 2**20, "MiB"))
    return rows


def _shares(case: str, metric: str, times: dict[str, float]) -> list[Row]:
    outside = 1 - times["network"] / times["step"]
    return [
        Row(case, metric, 1e3 * times["step"], "ms"),
        Row(case, f"{metric}, outside the network", outside, "1", "the whole step; the network alone, same run"),
    ]


def _available_memory(device: torch.device) -> int:
    """Bytes that can still be had without swapping."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    info = Path("/proc/meminfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _by_torch(call: Callable[[], object]) -> object:
    with plain_forms():
        return call()


def _bent(batch: SceneBatch, amount: float) -> Tensor:
    """Positions (K, 3) of the batch's scenes bent sideways, so that some neighbours are others than at rest."""
    height = batch.rest[:, 2] - batch.rest[:, 2].min()
    bent = batch.rest + torch.stack((amount * height**2, torch.zeros_like(height), torch.zeros_like(height)), 1)
    return torch.where((batch.kernels.unit < 0)[:, None], batch.rest, bent)


class Bound:
    """A simulator with random weights, a batch of its scene in motion, and what is timed of it."""

    def __init__(self, model: GausSim, members: int, options: Options, *, steps: int = 1) -> None:
        self.model, self.steps = model.to(options.device), steps
        self.batch: SceneBatch = model.batch((0,) * members)
        self.state = SimState(*(_bent(self.batch, amount) for amount in (0.3, 0.29)))
        self._inputs = self._seen_by_the_network()

    def _seen_by_the_network(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        seen: list[tuple[Tensor, Tensor, Tensor]] = []
        handle = self.model.predictor.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
        with torch.no_grad():
            self.model.eval().step(self.batch, self.state)
        handle.remove()
        return seen[-len(self.batch.levels) :]  # behind those of the anchor, where there is one

    def edges(self) -> int:
        """Edges of all predicted levels."""
        return sum(inputs[2].shape[1] for inputs in self._inputs)

    def differentiable(self) -> Tensor:
        """All steps with a graph from the initial state and the parameters; one number to differentiate."""
        state = SimState(self.state.positions, self.state.previous.clone().requires_grad_())
        prepared, total = self.model.prepare(self.batch), self.batch.rest.new_zeros(())
        for _ in range(self.steps):
            step = self.model.step(self.batch, state, None, prepared)
            state = SimState(step.positions, state.positions)
            total = (
                total + step.positions.sum() + step.deformation_gradients.sum() + step.rotations.sum() + step.momentum
            )
        return total

    def both(self) -> None:
        """Forward and backward, statistics of the inputs included."""
        self.model.train().zero_grad()
        self.differentiable().backward()

    @torch.no_grad()
    def forward(self) -> None:
        """Forward without a graph."""
        self.model.eval()
        prepared, state = self.model.prepare(self.batch), self.state
        for _ in range(self.steps):
            state = SimState(self.model.step(self.batch, state, None, prepared).positions, state.positions)

    @torch.no_grad()
    def network_forward(self) -> None:
        """The network of one step alone."""
        for inputs in self._inputs:
            self.model.predictor.network(*inputs)

    def network_both(self) -> None:
        """The network of one step alone, with gradients of its inputs and weights."""
        self.model.zero_grad()
        total = []
        for nodes, edges, index in self._inputs:
            total.append(
                self.model.predictor.network(nodes.clone().requires_grad_(), edges.clone().requires_grad_(), index)
            )
        torch.cat(total).sum().backward()

    def replay(self) -> Callable[[], object]:
        """The step as a CUDA graph."""
        self.model.eval()
        with torch.no_grad():
            prepared = self.model.prepare(self.batch)
        graphed = GraphedStep(lambda state, force: self.model.step(self.batch, state, force, prepared), self.batch.rest)
        return functools.partial(graphed, self.state)

    def parts(self) -> dict[str, Callable[[], object]]:
        """The parts of the finest level's forward pass, and those of the whole step."""
        model, batch, level = self.model.eval(), self.batch, self.batch.levels[-1]
        with torch.no_grad():
            prepared = model.prepare(batch)
            unit, above = _finest(prepared, self.state)
            index = model.predictor.edges.of(level, unit.now)
            target, gravity = unit.rest, model.predictor.gravity.to(unit.rest)
            choices = model.predictor.features

            def features() -> tuple[Tensor, Tensor]:
                return network_inputs(unit, target, above, index, level.length, level.dt, gravity, choices)

            nodes, edges = features()
            output = torch.zeros(level.count, 11).to(unit.rest)

        def recursion() -> object:
            gradient, rotation = gradient_from_output(output, conserve_mass=True)
            accumulated, turned, after = advance(gradient, rotation, target, above)
            solved = Solved(unit.rest, unit.now, unit.before, after, target, accumulated, turned, above.index)
            return inherit(solved, None, batch.kernels)

        parts: dict[str, Callable[[], object]] = {
            "constants": functools.partial(model.prepare, batch),
            "aggregation": lambda: (prepared.finest(self.state.positions), prepared.finest(self.state.previous)),
            "template": lambda: prepared.template(Motion(unit.rest, unit.now, unit.before)),
            "edges": lambda: [
                model.predictor.edges.of(one, x)
                for one, x in zip(batch.levels, prepared.per_level(prepared.finest(self.state.positions)), strict=True)
            ],
            "features": features,
            "normalisers": lambda: (model.predictor.node_normaliser(nodes), model.predictor.edge_normaliser(edges)),
            "network": self.network_forward,
            "recursion and kernels": recursion,
        }
        return {name: torch.no_grad()(part) for name, part in parts.items()}


def _finest(prepared: Prepared, state: SimState) -> tuple[Units, Solved]:
    """Units of the finest level, and the level above (or the roots) as if it had not moved."""
    now, before = (prepared.per_level(prepared.finest(x)) for x in (state.positions, state.previous))
    fixed, level = prepared.levels[-1], prepared.batch.levels[-1]
    unit = Units(fixed.rest, now[-1], before[-1], fixed.mass, fixed.log_density, fixed.attributes)
    if len(now) == 1:
        return unit, prepared.roots
    coarse = prepared.levels[-2].rest
    identity = torch.eye(3).to(coarse).repeat(len(coarse), 1, 1)
    return unit, Solved(coarse, now[-2], before[-2], coarse, coarse, identity, identity, level.parent)
