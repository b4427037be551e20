"""What training and a prediction cost: seconds and peak memory, measured meanwhile."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch

from gausim.runs.memory import give_back_freed_memory

T = TypeVar("T")
CUDA, RESIDENT = "CUDA allocated", "process, resident"
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class CostMeter:
    """Collects the costs of one method over sequences.

    Memory is what CUDA allocates where the model lives there, else what the process has resident (Linux), in which
    libraries and decoded videos outweigh any prediction. So what one prediction adds to what was there before is
    counted too, after memory that was freed earlier has been given back and could not hide it. The first prediction
    also builds what stays (the graph, compiled code) and is counted apart.
    """

    def __init__(self) -> None:
        self._seconds: list[float] = []
        self._frames = 0
        self._peak, self._added = 0, list[int]()
        self._kind: str | None = None
        self._drawing, self._images = 0.0, 0

    def predict(self, make: Callable[[], T], frames: int) -> T:
        """Runs ``make``, which predicts ``frames`` frames beyond the first, and counts what it costs."""
        cuda = torch.cuda.is_initialized()
        before = _begin(cuda)
        start = time.perf_counter()
        result = make()
        if cuda:
            torch.cuda.synchronize()
        self._seconds.append((time.perf_counter() - start) / max(1, frames))
        self._frames += frames
        peak = peak_bytes()
        if before is not None and peak is not None:
            self._kind = CUDA if cuda else RESIDENT
            self._peak = max(self._peak, peak)
            self._added.append(peak - before)
        return result

    def draw(self, make: Callable[[], T], images: int) -> T:
        """Runs ``make``, which draws ``images`` images, and counts its time."""
        start = time.perf_counter()
        result = make()
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self._drawing += time.perf_counter() - start
        self._images += images
        return result

    def summary(self) -> dict[str, Any]:
        """Plain data for ``metrics.json``; the first sequence warms up and counts only where it is the only one."""
        timed = self._seconds[1:] or self._seconds
        return {
            "seconds_per_frame": {"mean": statistics.fmean(timed), "std": statistics.pstdev(timed)},
            "frames": self._frames,
            "seconds_per_image": self._drawing / self._images if self._images else None,
            "memory": self._memory(),
            "device": torch.cuda.get_device_name() if torch.cuda.is_initialized() else "cpu",
            "threads": torch.get_num_threads(),
        }

    def _memory(self) -> dict[str, Any] | None:
        if not self._added:
            return None
        first, *others = self._added
        added = {"added_bytes": max(others or [first]), "first_added_bytes": first}
        return {"kind": self._kind, "peak_bytes": self._peak, **added}


class TrainingCost:
    """What training has cost so far, over interruptions.

    Attributes:
        seconds: wall time.
        cpu_seconds: processor time of this process.
        peak_bytes: the most that CUDA had allocated or this process had resident; 0 where unknown.
    """

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = self.peak_bytes = 0.0
        self.begin()

    def begin(self) -> None:
        """Counts from here."""
        self._mark = time.perf_counter(), time.process_time()

    def state_dict(self) -> dict[str, float]:
        """Counts up to now; plain numbers."""
        wall, processor = self._mark
        self.begin()
        self.seconds += self._mark[0] - wall
        self.cpu_seconds += self._mark[1] - processor
        self.peak_bytes = max(self.peak_bytes, float(peak_bytes() or 0))
        return self.summary()

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Goes on from what :meth:`state_dict` gave."""
        self.seconds, self.cpu_seconds = state["seconds"], state["cpu_seconds"]
        self.peak_bytes = state["peak_bytes"]

    def summary(self) -> dict[str, float]:
        """What was counted."""
        return {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, "peak_bytes": self.peak_bytes}

    def notes(self) -> list[str]:
        """The same in a sentence, if anything was counted."""
        if not self.seconds:
            return []
        return [
            f"Trained in {self.seconds / 60:.1f} minutes, {self.cpu_seconds / 60:.1f} of processor time; it held "
            f"{self.peak_bytes / 1e9:.1f} GB at most."
        ]


def peak_bytes() -> int | None:
    """The most that CUDA had allocated, or the process had resident, since it was last reset; None where unknown."""
    return torch.cuda.max_memory_allocated() if torch.cuda.is_initialized() else _resident("VmHWM")


def _begin(cuda: bool) -> int | None:
    """Resets the peak; returns the bytes in use."""
    if cuda:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    gc.collect()
    give_back_freed_memory()
    try:
        _RESET.write_text("5")  # proc(5): resets the peak resident size
    except OSError:
        return None
    return _resident("VmRSS")


def _resident(field: str) -> int | None:
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith(f"{field}:")]
    return int(found[0]) * 1024 if found else None
