"""What every benchmark shares: rows, interleaved timing and memory."""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor


@dataclass(frozen=True)
class Row:
    """One measured figure.

    Attributes:
        case: what was run, with its sizes.
        metric: what was measured of it.
        value: the figure.
        unit: its unit; ``x`` for a ratio, ``1`` for a share.
        reference: what a ratio or share compares with, in words; None for a plain figure.
    """

    case: str
    metric: str
    value: float
    unit: str
    reference: str | None = None


@dataclass(frozen=True)
class Options:
    """How a benchmark is run.

    Attributes:
        device: where.
        threads: of torch and of the renderer, unless a case is about threads.
        quick: tiny sizes that take seconds; to see that the command works, not to quote.
        rounds: timed calls of each candidate; the median is reported.
    """

    device: torch.device
    threads: int = 1
    quick: bool = False
    rounds: int = 7


def synchronise(device: torch.device) -> None:
    """Waits for the device, so that a clock read afterwards counts its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def medians(
    candidates: Mapping[str, Callable[[], object]],
    options: Options,
    *,
    rounds: int | None = None,
    warmup: int = 1,
) -> dict[str, float]:
    """Median wall time of each candidate [s].

    The candidates are called in turn, A B C A B C ..., so that a drift of the machine's speed meets all of them and
    their ratios hold where single times do not.

    Args:
        candidates: what is timed, by name.
        options: the device to wait for and the number of rounds.
        rounds: timed calls of each; ``options.rounds`` when None.
        warmup: calls of each that are not timed.
    """
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(warmup + (rounds or options.rounds)):
        for name, call in candidates.items():
            synchronise(options.device)
            start = time.perf_counter()
            call()
            synchronise(options.device)
            if number >= warmup:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def saved_bytes(call: Callable[[], object]) -> int:
    """Bytes of the distinct storages that autograd keeps for the backward pass while ``call`` runs.

    Counts what the graph holds, whatever the allocator does, so the figure is the same in every run. Parameters and
    inputs that the graph keeps are counted too: they stand on both sides of a ratio.
    """
    sizes: dict[int, int] = {}
    held: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in sizes:
            sizes[storage.data_ptr()] = storage.nbytes()
            held.append(tensor)  # an address must not be used twice
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = call()
    del result
    return sum(sizes.values())


def peak_resident() -> int:
    """Largest resident memory of this process so far [bytes]."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage counts what the parent held when it started this process
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Runs a block with this many threads inside torch's operations."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
