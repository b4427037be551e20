"""How functions are compiled by numba, the same everywhere."""

from __future__ import annotations

from typing import Any

# What Python calls. Kept in numba's cache; without the C entry that nothing uses.
KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "cache": True, "no_cfunc_wrapper": True}
# What only compiled functions call. It becomes part of each of them: else the process that compiles would call the
# helper's own code and a later one, which loads the caller from the cache, the copy linked into it, and under fastmath
# the two round differently (runs would not repeat bit for bit). Without entries of its own it takes half the time.
HELPER: dict[str, Any] = {
    "error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True, "no_cpython_wrapper": True,
}  # fmt: skip
# All of fastmath but nnan and ninf: what overflows must not turn into an undefined index later.
FINITE_MATH_OFF = {"contract", "reassoc", "arcp", "nsz", "afn"}
