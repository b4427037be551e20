"""Memory of the process: freed blocks that it keeps, as a rollout frees and allocates the same ones, and its size."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import Any

# mallopt parameters of glibc's malloc.h, and the largest threshold accepted on 64 bits.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, LARGEST_THRESHOLD = -1, -3, 32 << 20
KEEP_AT_TOP = (1 << 31) - 1


def keep_freed_memory() -> bool:
    """Makes glibc keep freed blocks; returns whether it succeeded (no effect on other systems).

    Returned blocks cost page faults on the next allocation, a third of the time of a training step on a CPU.
    """
    mallopt = _glibc("mallopt")
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_THRESHOLD)) and bool(mallopt(M_TRIM_THRESHOLD, KEEP_AT_TOP))


def give_back_freed_memory() -> bool:
    """Makes glibc return freed blocks to the system once; returns whether it succeeded (no effect on other systems)."""
    return bool(_glibc("malloc_trim")(0))


def process_memory(field: str, file: str = "/proc/self/status") -> int | None:
    """A field of a file in Linux' /proc [bytes]; None on other systems."""
    lines = Path(file).read_text().splitlines() if Path(file).is_file() else []
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)


def _glibc(name: str) -> Any:
    """A function of glibc; on other systems one without effect."""
    found = getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None
    return found or (lambda *_: 0)
