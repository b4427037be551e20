"""Cost of training and prediction in seconds and peak memory, and the memory that the process keeps."""

import ctypes
import gc
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch

T = TypeVar("T")
_RESET = Path("/proc/self/clear_refs")
# mallopt parameters of glibc's malloc.h, and the largest threshold accepted on 64 bits.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, LARGEST_THRESHOLD = -1, -3, 32 << 20
KEEP_AT_TOP = (1 << 31) - 1


class CostMeter:
    """Collects the costs of one method over sequences.

    Memory is that allocated by CUDA if the model is on a GPU, otherwise the resident memory of the process (Linux),
    most of which are libraries and decoded videos. The increase during a prediction is therefore recorded, too, after
    freed memory has been returned to the system. The first prediction also builds persistent structures (the graph,
    compiled code) and is recorded separately.
    """

    def __init__(self) -> None:
        self._seconds: list[float] = []
        self._peak, self._added = 0, list[int]()
        self._drawing, self._images = 0.0, 0

    def predict(self, make: Callable[[], T], frames: int) -> T:
        """Runs ``make``, which predicts ``frames`` frames beyond the first, and records its cost."""
        cuda = torch.cuda.is_initialized()
        before = _begin(cuda)
        result, seconds = _timed(make)
        self._seconds.append(seconds / max(1, frames))
        peak = peak_bytes()
        if before is not None and peak is not None:
            self._peak = max(self._peak, peak)
            self._added.append(peak - before)
        return result

    def draw(self, make: Callable[[], T], images: int) -> T:
        """Runs ``make``, which renders ``images`` images, and records its time."""
        result, seconds = _timed(make)
        self._drawing += seconds
        self._images += images
        return result

    def summary(self) -> dict[str, Any]:
        """Plain data for ``metrics.json``; the first sequence is a warm-up, included only if it is the only one."""
        timed = self._seconds[1:] or self._seconds
        return {
            "seconds_per_frame": statistics.fmean(timed),
            "seconds_per_image": self._drawing / self._images if self._images else None,
            "memory": self._memory(),
            "device": torch.cuda.get_device_name() if torch.cuda.is_initialized() else "cpu",
            "threads": torch.get_num_threads(),
        }

    def _memory(self) -> dict[str, Any] | None:
        if not self._added:
            return None
        kind = "CUDA allocated" if torch.cuda.is_initialized() else "process, resident"
        return {"kind": kind, "peak_bytes": self._peak, "added_bytes": max(self._added[1:] or self._added)}


class TrainingCost:
    """Cost of training so far, summed over interruptions.

    Attributes:
        seconds: wall time.
        cpu_seconds: processor time of this process.
        peak_bytes: peak memory allocated by CUDA, or resident in this process; 0 where unknown.
    """

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = self.peak_bytes = 0.0
        self.begin()

    def begin(self) -> None:
        """Starts the measurement."""
        self._mark = time.perf_counter(), time.process_time()

    def state_dict(self) -> dict[str, float]:
        """Cost up to now as plain numbers."""
        self._advance()
        self.peak_bytes = max(self.peak_bytes, float(peak_bytes() or 0))
        return self.summary()

    def minutes(self, clock: str) -> float:
        """Time up to now by the clock ``wall`` or ``cpu`` [minutes]."""
        self._advance()
        return (self.seconds if clock == "wall" else self.cpu_seconds) / 60

    def _advance(self) -> None:
        wall, processor = self._mark
        self.begin()
        self.seconds += self._mark[0] - wall
        self.cpu_seconds += self._mark[1] - processor

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Continues from the result of :meth:`state_dict`."""
        self.seconds, self.cpu_seconds = state["seconds"], state["cpu_seconds"]
        self.peak_bytes = state["peak_bytes"]

    def summary(self) -> dict[str, float]:
        """The recorded cost."""
        return {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, "peak_bytes": self.peak_bytes}

    def notes(self) -> list[str]:
        """The recorded cost in a sentence, if any."""
        if not self.seconds:
            return []
        return [
            f"Trained in {self.seconds / 60:.1f} minutes, {self.cpu_seconds / 60:.1f} of processor time; it held "
            f"{self.peak_bytes / 1e9:.1f} GB at most."
        ]


def _timed(make: Callable[[], T]) -> tuple[T, float]:
    """The result of a function, and its wall time with the work of the GPU [s]."""
    start = time.perf_counter()
    result = make()
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return result, time.perf_counter() - start


def peak_bytes() -> int | None:
    """Peak memory allocated by CUDA, or resident in the process, since the last reset; None where unknown."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_initialized() else process_memory("VmHWM")


def _begin(cuda: bool) -> int | None:
    """Resets the peak; returns the bytes in use."""
    if cuda:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    gc.collect()
    _glibc("malloc_trim")(0)  # returns freed blocks to the system
    try:
        _RESET.write_text("5")  # proc(5): resets the peak resident size
    except OSError:
        return None
    return process_memory("VmRSS")


def keep_freed_memory() -> bool:
    """Makes glibc keep freed blocks; returns whether it succeeded (no effect on other systems).

    Returned blocks cost page faults on the next allocation, a third of the time of a training step on a CPU.
    """
    mallopt = _glibc("mallopt")
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_THRESHOLD)) and bool(mallopt(M_TRIM_THRESHOLD, KEEP_AT_TOP))


def process_memory(field: str, file: str = "/proc/self/status") -> int | None:
    """A field of a file in Linux' /proc [bytes]; None on other systems."""
    lines = Path(file).read_text().splitlines() if Path(file).is_file() else []
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)


def _glibc(name: str) -> Any:
    """A function of glibc; on other systems one without effect."""
    found = getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None
    return found or (lambda *_: 0)
