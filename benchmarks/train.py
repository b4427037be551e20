"""Training: sequence-steps per second of whole optimiser steps, fast forms against plain ones, memory of the graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch.optim import Optimizer

from benchmarks.harness import Options, Row, medians, peak_memory, peak_saved_bytes
from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.kernels.operations import OPERATIONS, plain_forms
from gausim.training.module import GausSimModule

SEQUENCES = 4  # of an optimiser step, at most
SLOW_ROUNDS = 2  # timed steps of plain torch
OVERRIDES, RIVAL = ("data=demo", "model=gausim"), "model=gausim_network"


def run(options: Options, overrides: Sequence[str] = ()) -> list[Row]:
    """Optimiser steps of a training configuration (KEY=VALUE) against those of the model in ``RIVAL``.

    Raises:
        DataError: the data set is not there.
        ConfigError: the model is fitted to one sequence after another.
    """
    from gausim.compose.build import build
    from gausim.compose.command import with_data_directories
    from gausim.compose.config import compose

    words = with_data_directories(overrides or OVERRIDES)
    own, rival = compose(words), compose([*(w for w in words if not w.startswith("model")), RIVAL])
    made = [build(config) for config in (own, rival)[: 1 if own.model == rival.model else 2]]
    modules = [module for module, _ in made if isinstance(module, GausSimModule)]
    if len(modules) < len(made):
        raise ConfigError("benchmarks train: expected a model that learns by batches, such as model=gausim.")
    return measure(options, modules[0], made[0][1], dict(zip([RIVAL], modules[1:], strict=False)))


@dataclass
class Case:
    """A module with a batch and an optimiser of rate zero, so that all steps are equal."""

    module: GausSimModule
    samples: list[SequenceSample]
    optimizer: Optimizer

    @staticmethod
    def of(module: GausSimModule, data: ReadyDataModule, options: Options, steps: int) -> Case:
        """A case of the first sequences, with T = ``steps``."""
        chosen = range(min(SEQUENCES, len(data.index)))
        views = [data.index.objects[data.index.entries[i][0]].train_views for i in chosen]
        frames = range(steps + 1)
        samples = [data.index.sample(i, frames, v).to(options.device) for i, v in zip(chosen, views, strict=True)]
        module.to(options.device).train()
        module.objective = replace(module.objective, static_probability=0.0)
        optimizer = module.configure_optimizers()
        for group in optimizer.param_groups:
            group["lr"] = 0.0
        return Case(module, samples, optimizer)

    def step(self) -> None:
        """One optimiser step without the static loss, which only some batches have."""
        self.module.optimise(self.samples, self.optimizer, torch.Generator().manual_seed(0))


def measure(
    options: Options, module: GausSimModule, data: ReadyDataModule, others: Mapping[str, GausSimModule]
) -> list[Row]:
    """Times of optimiser steps, and memory, at the plan's largest T; weights stay constant.

    ``others`` are modules of the same data for comparison, by the setting that selects them.
    """
    data.setup("fit")
    longest = (data.plan.t_max if data.plan else None) or 1
    steps = min(3, longest) if options.quick else longest
    case = Case.of(module, data, options, steps)
    cameras = case.samples[0].cameras
    size = f"{len(cameras.names)} views x {cameras.width}x{cameras.height}, T={steps}"
    name = f"{case.samples[0].object_name}: {len(case.samples)} sequences x {size}"
    whole = medians({"": case.step}, options)[""]
    calls: dict[str, Callable[[], object]] = {"own": case.step, "plain": plain_forms()(case.step)}
    calls |= {form: plain_forms([form])(case.step) for form in OPERATIONS}
    calls |= {setting: Case.of(other, data, options, steps).step for setting, other in others.items()}
    found = medians(calls, replace(options, rounds=min(SLOW_ROUNDS, options.rounds)))
    rows = [Row(name, "throughput", steps * len(case.samples) / whole, "sequence-steps/s")]
    rows.append(Row(name, "optimiser step", 1e3 * whole, "ms"))
    rows += [Row(name, f"throughput / {setting}", found[setting] / found["own"], "x", "same run") for setting in others]
    plain = "every operation but the renderer as plain torch"
    rows.append(Row(name, "throughput / plain", found["plain"] / found["own"], "x", plain))
    rows += [Row(name, f"speed-up by {form}", found[form] / found["own"], "x", "its plain form") for form in OPERATIONS]
    rows.append(Row(name, "held for the backward pass, at most", peak_saved_bytes(case.step) / 2**20, "MiB"))
    return [*rows, peak_memory(name, options.device)]
