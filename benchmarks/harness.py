"""Tools of benchmarks: rows, interleaved timing, and memory that autograd keeps."""

from __future__ import annotations

import statistics
import time
import weakref
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.step.simulator import GausSim
from gausim.runs.cost import process_memory


@dataclass(frozen=True)
class Row:
    """One measured figure; ``reference`` names what a ratio divides by."""

    case: str
    metric: str
    value: float
    unit: str  # x for a ratio, 1 for a fraction or a count
    reference: str = ""


@dataclass(frozen=True)
class Options:
    """Options of a benchmark."""

    device: torch.device = torch.device("cpu")
    threads: int = 1
    quick: bool = False  # tiny sizes, to see that it works
    rounds: int = 7  # timed calls of each candidate


def seconds_of(call: Callable[[], object], device: torch.device, repeats: int = 1) -> float:
    """Wall time of one call, including its work on the device; the mean of ``repeats`` calls [s]."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    wait()
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    wait()
    return (time.perf_counter() - start) / repeats


def medians(
    candidates: Mapping[str, Callable[[], object]], options: Options, *, warmup: int = 1, at_least: float = 0.0
) -> dict[str, float]:
    """Median wall time of each candidate [s], over ``options.rounds`` rounds after ``warmup`` ones.

    The candidates are called in turn, A B C A B C ..., so that a drift of the machine's speed cancels in ratios.
    Calls shorter than ``at_least`` [s] in the warm-up are repeated to that time.
    """
    times: dict[str, list[float]] = {name: [] for name in candidates}
    repeats = dict.fromkeys(candidates, 1)
    for number in range(warmup + options.rounds):
        for name, call in candidates.items():
            seconds = seconds_of(call, options.device, repeats[name])
            if number < warmup:
                repeats[name] = max(1, int(at_least / seconds))
            else:
                times[name].append(seconds)
    return {name: statistics.median(values) for name, values in times.items()}


def peak_memory(case: str, device: torch.device) -> Row:
    """Peak memory so far: allocated on the device, or resident in this process."""
    on_gpu = device.type == "cuda"
    held = torch.cuda.max_memory_allocated(device) if on_gpu else process_memory("VmHWM") or 0
    return Row(case, f"{'device' if on_gpu else 'process'} memory, at most", held / 2**20, "MiB")


class _Kept:
    """A tensor that the graph keeps, detached: an operation that saves its result would make a reference cycle."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor.detach()


class _Ledger:
    """Bytes of the distinct storages that the graph keeps, now and at most."""

    def __init__(self) -> None:
        self.now = self.peak = 0
        self._held: Counter[tuple[int, int]] = Counter()

    def keep(self, tensor: Tensor) -> _Kept:
        kept, storage = _Kept(tensor), tensor.untyped_storage()
        key = storage.data_ptr(), storage.nbytes()
        self._count(key, 1)
        weakref.finalize(kept, self._count, key, -1)
        return kept

    def _count(self, key: tuple[int, int], change: int) -> None:
        before = self._held[key]
        self._held[key] += change
        self.now += key[1] * (bool(self._held[key]) - bool(before))
        self.peak = max(self.peak, self.now)


def peak_saved_bytes(call: Callable[[], object]) -> int:
    """Peak size of the distinct storages that autograd keeps for backward passes during ``call`` [bytes].

    It counts the graph's tensors, parameters and inputs among them, independent of the allocator, so the figure is
    the same in every run.
    """
    ledger = _Ledger()
    with torch.autograd.graph.saved_tensors_hooks(ledger.keep, lambda kept: kept.tensor):
        call()
    return ledger.peak


def cloud(count: int, *, degree: int = 1) -> GaussianScene:
    """Kernels uniform in an ellipsoid with axes 0.8, 0.6 and 1, the lowest twentieth pinned; SH of ``degree``."""
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
        name=f"cloud{count}",
    )


def simulator_of(preset: str, scene: GaussianScene, *settings: str) -> GausSim:
    """The untrained simulator of ``conf/model/PRESET.yaml`` for a scene at 24 frames per second, with KEY=VALUE."""
    from gausim.compose.config import compose, instantiate

    config = compose([f"model={preset}", *(f"model.simulator.{setting}" for setting in settings)])
    made: GausSim = instantiate(config.model.simulator)(scenes=[scene], fps=[24.0])
    return made
