"""Checks that several ranks run together, for ``killed_runs.py``: it forks as many processes, which meet by gloo."""

import json
import os
import signal
import sys
import tempfile
import traceback
from dataclasses import replace
from datetime import timedelta
from typing import Any

import torch
from torch import distributed as dist

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import DivergenceError
from gausim.data.dataset import SequenceSample
from gausim.losses import Objective
from gausim.metrics.image import PSNR
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings
from gausim.training.ranks.ranks import Ranks
from helpers import sway, toy_object
from helpers.plain import digest

SCENES = (0, 0, 1, 0, 1, 1)  # of sequences 0 to 5; the last is in no batch
AMPLITUDES = (0.4, -0.25, 0.3, -0.35, 0.2, 0.1)


def real_module(objective: Objective, dtype: torch.dtype, settings: OptimizerSettings) -> GausSimModule:
    parts = {"renderer": ReferenceRenderer(), "objective": objective, "optimizer": settings}
    return sway.real_module(SCENES, parts=parts, dtype=dtype, output_scale=0.02)


def samples(count: int, steps: int, dtype: torch.dtype) -> list[SequenceSample]:
    """Of one view."""
    made, cameras = [], sway.cast(toy_object.cameras().select([0]), dtype)
    for number in range(count):
        whole = sway.sample(0, steps, AMPLITUDES[number])
        own = {"scene_id": SCENES[number], "sequence_id": number, "sequence_name": f"seq_{number}"}
        made.append(replace(whole, frames=whole.frames[:, :1], cameras=cameras, **own))
    return made


def train(options: dict[str, Any]) -> dict[str, Any]:
    """Optimiser steps on the union of ``count`` sequences: gradients of the last one, weights, numbers."""
    ranks, dtype = Ranks(), getattr(torch, options.get("dtype", "float32"))
    terms = {"static_weight": 1.0, "momentum_weight": 1.0, "backprop_steps": 1}
    objective = Objective(**{**terms, **options.get("objective", {})})
    module = real_module(objective, dtype, OptimizerSettings(torch.optim.Adam, clip_per_group=False, decay={}))
    with torch.no_grad():
        for parameter in module.simulator.parameter_groups()["network"]:
            parameter.mul_(options.get("wild", 1.0))
    optimizer, whole = module.configure_optimizers(), samples(options["count"], options.get("steps", 3), dtype)
    share, stats = whole[ranks.rank :: ranks.size], []
    for step in range(options.get("times", 1)):
        try:
            stats.append(module.optimise(share, optimizer, torch.Generator().manual_seed(step)))
        except DivergenceError as error:
            return {"error": str(error)}
    named = dict(module.named_parameters())
    return {
        "stats": stats,
        "grads": {n: None if p.grad is None else p.grad.double().flatten().tolist() for n, p in named.items()},
        "statistics": {n: b.double().flatten().tolist() for n, b in module.named_buffers() if "normaliser" in n},
        "weights": digest(dict(module.state_dict())),
        "baselines": sorted(module.baselines.state_dict()),
    }


def metrics(options: dict[str, Any]) -> float:
    """A metric of this rank's share of ``count`` images, some ranks perhaps without any."""
    ranks, generator = Ranks(), torch.Generator().manual_seed(0)
    truth, drawn = torch.rand(2, options["count"], 8, 8, 3, generator=generator)
    metric, own = PSNR(), slice(ranks.rank, None, ranks.size)
    if len(truth[own]):
        metric.update(drawn[own], truth[own], torch.ones(len(truth[own]), 8, 8, dtype=torch.bool))
    return float(metric.compute())


def fail(options: dict[str, Any]) -> str:
    """The second rank dies while the others wait for it."""
    ranks = Ranks()
    if ranks.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    ranks.gather(ranks.rank)
    return "not reached"


def first(options: dict[str, Any]) -> str:
    """What the first rank raises, the others hear of."""

    def broken() -> str:
        raise ValueError(f"from {os.getpid()}")

    value = Ranks().first(lambda: "one answer")
    try:
        Ranks().first(broken)
    except Exception as error:
        return f"{value}; {type(error).__name__}: {error}"
    return "nothing raised"


def drifted(options: dict[str, Any]) -> str:
    """Four ranks, the last two unlike the first two."""
    try:
        Ranks().check_alike(f"{Ranks().rank // 2}", "weights")
    except Exception as error:
        return str(error)
    return "alike"


def child(order: dict[str, Any], rank: int, store: str, answer: int) -> None:
    torch.set_num_threads(1)
    signal.alarm(60)
    try:
        if order["ranks"] > 1:
            dist.init_process_group(
                "gloo", store=dist.FileStore(store, order["ranks"]), rank=rank, world_size=order["ranks"],
                timeout=timedelta(seconds=30),
            )  # fmt: skip
        found = globals()[order["check"]](order.get("options", {}))
    except BaseException as error:
        traceback.print_exc()
        found = f"{type(error).__name__}: {error}"
    with os.fdopen(answer, "w") as pipe:
        json.dump(found, pipe)
    sys.stderr.flush()
    os._exit(0)


def run(order: dict[str, Any]) -> list[Any]:
    """Forks the ranks of an order (check, ranks, options); what each found, None from one that died."""
    readers, pids = [], []
    with tempfile.TemporaryDirectory() as folder:
        for rank in range(order["ranks"]):
            reader, writer = os.pipe()
            pid = os.fork()
            if pid == 0:
                child(order, rank, f"{folder}/store", writer)
            os.close(writer)
            readers.append(os.fdopen(reader))
            pids.append(pid)
        texts = [reader.read() for reader in readers]
        for pid in pids:
            os.waitpid(pid, 0)
    return [json.loads(text) if text else None for text in texts]


torch.set_num_threads(1)
# What is loaded here, every fork has; a forward pass leaves no threads behind.
real_module(Objective(), torch.float32, OptimizerSettings()).predict_images(samples(1, 1, torch.float32)[0])
