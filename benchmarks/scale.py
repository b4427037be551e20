"""A training at the paper's size, stage by stage: processor time, memory, and the whole for 30 sequences."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from statistics import median
from typing import TypeVar

import torch

from benchmarks.harness import Options, Row, peak_memory
from benchmarks.train import Case
from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.runs.cost import process_memory
from gausim.training.module import GausSimModule
from gausim.training.plan import TrainingPlan
from gausim.training.tracking import track
from gausim.training.warm_start import warm_start

# The paper's set: 23,422 kernels, five views of 960 x 540, 30 sequences.
OVERRIDES, SEQUENCES = ("data=data/paper_size", "model=gausim", "data.sequences=2"), 30
T = TypeVar("T")
UPDATES = {False: 20, True: 2}  # timed updates of the fit, after one that compiles


def run(options: Options, overrides: Sequence[str] = ()) -> list[Row]:
    """Stages of the training that the settings (KEY=VALUE) describe, with all sequences that they choose.

    Raises:
        DataError: the data set is not there.
        ConfigError: the model has no warm start.
    """
    from gausim.compose.build import build
    from gausim.compose.command import with_data_directories
    from gausim.compose.config import compose

    module, data = build(compose(with_data_directories(overrides or OVERRIDES)))
    if not isinstance(module, GausSimModule):
        raise ConfigError("benchmarks scale: expected a model that learns by batches, such as model=gausim.")
    return measure(options, module, data, module.plan)


def measure(options: Options, module: GausSimModule, data: ReadyDataModule, plan: TrainingPlan) -> list[Row]:
    """Seconds of every stage, per sequence or update; the whole training by the plan; memory."""
    if plan.warm_start is None or plan.epochs is None:
        raise ConfigError("benchmarks scale: expected a resolved plan with a warm start.")
    data.setup("fit")
    module.to(options.device)
    count, updates = len(data.index.entries), UPDATES[options.quick]
    tracks, tracking = _timed(lambda: track(module, data, quiet=True), options)
    few = [replace(plan.warm_start, updates=number) for number in (1, 1 + updates)]
    first, more = (_timed(partial(warm_start, module, tracks, own, quiet=True), options)[1] for own in few)
    case = Case.of(module, data, options, plan.t_max or 1)
    spent = [_timed(case.step, options)[1] for _ in range(1 + options.rounds)]
    show = median(spent[1:]) / len(case.samples)
    resident = process_memory("VmRSS") or 0
    reading = [_timed(partial(data.training_sample, i, plan.t_max or 1), options)[1] for i in range(count)]
    grown = (process_memory("VmRSS") or 0) / max(1, resident)
    update, shows = (more - first) / updates, plan.epochs * plan.repeats * SEQUENCES
    stages = {
        "tracking": tracking / count * SEQUENCES, "fit": update * plan.warm_start.updates, "images": show * shows,
    }  # fmt: skip
    kernels, cameras = module.scenes[0].count, case.samples[0].cameras
    name = f"{kernels} kernels, {len(cameras.names)} views of {cameras.width} x {cameras.height}, T={plan.t_max}"
    rows = [
        Row(name, "tracking, per sequence", tracking / count, "s"),
        Row(name, "fit, per update", update, "s"),
        Row(name, "optimiser step, per sequence", show, "s"),
        Row(name, "reading, per sequence", max(reading) / show, "x", "its part of an optimiser step"),
    ]
    whole = f"{SEQUENCES} sequences, {plan.epochs} epochs of {plan.repeats} uses"
    rows += [Row(whole, stage, seconds / 3600, "h") for stage, seconds in stages.items()]
    rows.append(Row(whole, "training", sum(stages.values()) / 3600, "h"))
    rows.append(peak_memory(name, options.device))
    return [*rows, Row(name, "resident memory, all sequences read", grown, "x", "before")]


def _timed(call: Callable[[], T], options: Options) -> tuple[T, float]:
    """The result of a call, and its processor time, on a GPU its wall time [s]."""
    clock = time.perf_counter if options.device.type == "cuda" else time.process_time
    start = clock()
    result = call()
    if options.device.type == "cuda":
        torch.cuda.synchronize()
    return result, clock() - start
