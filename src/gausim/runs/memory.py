"""Keeps freed memory in the process: a rollout frees and asks for the same large blocks at every step."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

# mallopt parameters of glibc's malloc.h, and the largest threshold it accepts on 64 bits.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, LARGEST_THRESHOLD = -1, -3, 32 << 20
KEEP_AT_TOP = (1 << 31) - 1


def keep_freed_memory() -> bool:
    """Asks glibc not to return freed blocks to the system; returns whether it agreed (elsewhere nothing happens).

    Every block that is returned is paid for again in page faults, a third of the time of a training step on a CPU.
    """
    mallopt = _glibc("mallopt")
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_THRESHOLD)) and bool(mallopt(M_TRIM_THRESHOLD, KEEP_AT_TOP))


def give_back_freed_memory() -> bool:
    """Asks glibc to return freed blocks to the system once; returns whether it could (elsewhere nothing happens)."""
    return bool(_glibc("malloc_trim")(0))


def _glibc(name: str) -> Any:
    """A function of glibc; where there is none, one that does nothing."""
    found = getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None
    return found or (lambda *_: 0)
