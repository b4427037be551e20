"""Keeps freed memory in the process: a rollout frees and asks for the same large blocks at every step."""

from __future__ import annotations

import ctypes
import sys

# mallopt parameters of glibc's malloc.h, and the largest threshold it accepts on 64 bits.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, LARGEST_THRESHOLD = -1, -3, 32 << 20
KEEP_AT_TOP = (1 << 31) - 1


def keep_freed_memory() -> bool:
    """Asks glibc not to return freed blocks to the system; returns whether it agreed (elsewhere nothing happens).

    Every block that is returned is paid for again in page faults, a third of the time of a training step on a CPU.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_THRESHOLD)) and bool(mallopt(M_TRIM_THRESHOLD, KEEP_AT_TOP))


def give_back_freed_memory() -> bool:
    """Asks glibc to return freed blocks to the system once; returns whether it could (elsewhere nothing happens)."""
    if not sys.platform.startswith("linux"):
        return False
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return malloc_trim is not None and bool(malloc_trim(0))
