"""Benchmark of training: sequence-steps per second of optimiser steps, times of their parts, memory of the graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.optim import Optimizer

from gausim.benchmark.harness import Options, Row, medians, peak_resident, peak_saved_bytes, spent_in, torch_threads
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.kernels.operations import OPERATIONS, plain_forms
from gausim.training.module import GausSimModule
from gausim.training.supervision.comparison import Comparison

# Largest number of sequences of an optimiser step; timed steps of plain torch, which is slow.
SEQUENCES, REFERENCE_ROUNDS = 4, 2


@dataclass
class _Case:
    """A module with a batch and an optimiser of rate zero, so that all steps are equal."""

    module: GausSimModule
    samples: list[SequenceSample]
    optimizer: Optimizer

    @staticmethod
    def of(module: GausSimModule, datamodule: ReadyDataModule, options: Options, steps: int) -> _Case:
        index = datamodule.index
        chosen = range(min(SEQUENCES, len(index)))
        views = [index.objects[index.entries[i][0]].train_views for i in chosen]
        samples = [index.sample(i, range(steps + 1), v).to(options.device) for i, v in zip(chosen, views, strict=True)]
        module.to(options.device)
        module.train()
        module.measuring = False  # gradient fractions are measured in every fiftieth step only
        optimizer = module.configure_optimizers()
        for group in optimizer.param_groups:
            group["lr"] = 0.0
        return _Case(module, samples, optimizer)

    @property
    def steps(self) -> int:
        return self.samples[0].steps

    def step(self, *, static: bool = False) -> None:
        """One optimiser step with or without the static loss, which only some batches have."""
        own = self.module.objective
        self.module.objective = replace(own, static_probability=1.0 if static and own.static_weight else 0.0)
        try:
            self.module.optimise(self.samples, self.optimizer, torch.Generator().manual_seed(0))
        finally:
            self.module.objective = own


def run(
    options: Options, module: GausSimModule, datamodule: ReadyDataModule, others: Mapping[str, GausSimModule]
) -> list[Row]:
    """Times of optimiser steps and their parts, and memory of the graph, at the curriculum's largest T.

    The module's weights stay constant, its running statistics change. ``others`` are modules of the same data for
    comparison, by the setting that selects them.
    """
    datamodule.setup("fit")
    t_max = datamodule.curriculum.t_max
    length = min(3, t_max) if options.quick else t_max
    with torch_threads(options.threads):
        case = _Case.of(module, datamodule, options, length)
        cameras = case.samples[0].cameras
        name = (
            f"{case.samples[0].object_name}: {len(case.samples)} sequences x {len(cameras.names)} views x "
            f"{cameras.width}x{cameras.height}, T={case.steps}"
        )
        rivals = {setting: _Case.of(other, datamodule, options, length) for setting, other in others.items()}
        return [*_speed(name, case, rivals, options), *_memory(name, case, options)]


def _speed(name: str, case: _Case, rivals: Mapping[str, _Case], options: Options) -> list[Row]:
    times = medians({"without": case.step, "with": lambda: case.step(static=True)}, options)
    static = case.module.objective.static_chance(case.steps) * max(0.0, times["with"] - times["without"])
    whole = times["without"] + static
    parts = _parts(case, options)
    parts["static loss (by its fraction of the batches)"] = static
    parts["rest"] = whole - sum(parts.values())
    compared: dict[str, Callable[[], object]] = {form: plain_forms([form])(case.step) for form in OPERATIONS}
    compared |= {"own": case.step, "plain": plain_forms()(case.step)}
    compared |= {setting: rival.step for setting, rival in rivals.items()}
    found = medians(compared, options, rounds=min(REFERENCE_ROUNDS, options.rounds))
    own = found["own"] + static
    plain = "the same step with every operation but the renderer as plain torch"
    return [
        Row(name, "throughput", case.steps * len(case.samples) / whole, "sequence-steps/s"),
        *(Row(name, f"throughput / {setting}", found[setting] / found["own"], "x", "same run, without the static loss")
          for setting in rivals),
        Row(name, "throughput / plain", (found["plain"] + static) / own, "x", plain),
        Row(name, "optimiser step", 1e3 * whole, "ms"),
        *(Row(name, part, seconds / whole, "1", "of the optimiser step") for part, seconds in parts.items()),
        *(Row(name, f"speed-up by {form}", (found[form] + static) / own, "x", "its fast form against the plain")
          for form in OPERATIONS),
    ]  # fmt: skip


def _parts(case: _Case, options: Options) -> dict[str, float]:
    """Times of the parts of a step without the static loss, means over the rounds [s]."""
    module, optimizer = case.module, type(case.optimizer)
    places: dict[str, list[tuple[Any, str]]] = {
        "rollout": [(type(module.simulator), "prepare"), (type(module.simulator), "step")],
        "comparison": [(Comparison, "__call__")],
        "image loss with its gradient": [(type(module.objective.image), "value_and_gradient")],
        "backwards through the rollout": [(torch.autograd, "backward")],
        "optimiser": [(optimizer, "step")],
    }
    with spent_in(places, options.device) as seconds:
        for _ in range(options.rounds):
            case.step()
    drawing = "drawing, forwards and backwards"
    found = {name: spent / options.rounds for name, spent in seconds.items()}
    found[drawing] = found.pop("comparison") - found["image loss with its gradient"]
    return found


def _memory(name: str, case: _Case, options: Options) -> list[Row]:
    rows = [Row(name, "held for the backward pass, at most", peak_saved_bytes(case.step) / 2**20, "MiB")]
    if options.device.type == "cuda":
        rows.append(Row(name, "device memory, at most", torch.cuda.max_memory_allocated(options.device) / 2**20, "MiB"))
    return [*rows, Row(name, "process memory, at most", peak_resident() / 2**20, "MiB")]
