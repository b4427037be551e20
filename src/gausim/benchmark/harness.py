"""Tools of benchmarks: rows, interleaved timing and memory."""

from __future__ import annotations

import functools
import platform
import resource
import statistics
import sys
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from gausim import __version__
from gausim.runs import provenance
from gausim.runs.cost import process_memory


@dataclass(frozen=True)
class Row:
    """One measured figure."""

    case: str  # the benchmark's case, with its sizes
    metric: str  # the measured quantity
    value: float
    unit: str  # x for a ratio, 1 for a fraction
    reference: str | None = None  # reference of a ratio or fraction, in words


@dataclass(frozen=True)
class Options:
    """Options of a benchmark."""

    device: torch.device
    threads: int = 1  # of torch and of the renderer, except in cases about threads
    quick: bool = False  # tiny sizes for a test of the command, in seconds
    rounds: int = 7  # timed calls of each candidate; the median is reported


def seconds_of(call: Callable[[], object], device: torch.device, repeats: int = 1) -> float:
    """Wall time of one call, including its work on the device; the mean of ``repeats`` calls [s]."""
    _synchronise(device)
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    _synchronise(device)
    return (time.perf_counter() - start) / repeats


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def medians(
    candidates: Mapping[str, Callable[[], object]],
    options: Options,
    *,
    rounds: int | None = None,
    warmup: int = 1,
    at_least: float = 0.0,
) -> dict[str, float]:
    """Median wall time of each candidate [s], over ``rounds`` (default ``options.rounds``) after ``warmup`` calls.

    The candidates are called in turn, A B C A B C ..., so that a drift of the machine's speed affects all of them
    and cancels in their ratios. Calls shorter than ``at_least`` [s] in the warm-up are repeated to that time.
    """
    times: dict[str, list[float]] = {name: [] for name in candidates}
    repeats = dict.fromkeys(candidates, 1)
    for number in range(warmup + (rounds or options.rounds)):
        for name, call in candidates.items():
            seconds = seconds_of(call, options.device, repeats[name])
            if number < warmup:
                repeats[name] = max(1, int(at_least / seconds))
            else:
                times[name].append(seconds)
    return {name: statistics.median(values) for name, values in times.items()}


class _Kept:
    """A tensor that the graph keeps."""

    def __init__(self, tensor: Tensor) -> None:
        # Detached, because an operation that saves its result would create a reference cycle.
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

    It counts the graph's tensors, independent of the allocator, so the figure is the same in every run. It includes
    parameters and inputs that the graph keeps, on both sides of a ratio.
    """
    ledger = _Ledger()
    with torch.autograd.graph.saved_tensors_hooks(ledger.keep, lambda kept: kept.tensor):
        call()
    return ledger.peak


def peak_resident() -> int:
    """Largest resident memory of this process so far [bytes]."""
    known = process_memory("VmHWM")  # getrusage includes the parent's memory at the start of this process
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return known or (peak if sys.platform == "darwin" else 1024 * peak)


@contextmanager
def spent_in(parts: Mapping[str, Sequence[tuple[Any, str]]], device: torch.device) -> Iterator[dict[str, float]]:
    """Context that measures the time spent in functions (owner and attribute), by the name of their part [s]."""
    seconds = dict.fromkeys(parts, 0.0)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            results: list[Any] = []
            seconds[name] += seconds_of(lambda: results.append(function(*args, **options)), device)
            return results[0]

        return call

    with ExitStack() as stack:
        for name, places in parts.items():
            for owner, attribute in places:
                stack.enter_context(patch.object(owner, attribute, timed(name, getattr(owner, attribute))))
        yield seconds


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Context with ``count`` threads in torch's operations."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def machine(options: Options) -> dict[str, str]:
    """Processor, device and software of the benchmark."""
    return {
        "processor": f"{provenance.machine()}, {torch.backends.cpu.get_cpu_capability()}",
        "system": f"{platform.system()} {platform.machine()}",
        "software": f"gausim {__version__}, Python {platform.python_version()}, torch {torch.__version__}, "
        f"numba {version('numba')}",
        "threads": str(options.threads),
        "sizes": "quick (not to be quoted)" if options.quick else "full",
    }
