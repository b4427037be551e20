"""Options of numba for all compiled functions."""

from __future__ import annotations

from typing import Any

# Functions called from Python. Kept in numba's cache; without the unused C entry.
KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "cache": True, "no_cfunc_wrapper": True}
# Functions called only by compiled functions, inlined into each of them. Otherwise the process that compiles would call
# the helper's code, and a later process, which loads the caller from the cache, the copy linked into it: under fastmath
# both round differently, and runs would not repeat bit for bit. Without entry points compiling takes half the time.
HELPER: dict[str, Any] = {
    "error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True, "no_cpython_wrapper": True,
}  # fmt: skip
# fastmath without nnan and ninf: a number that overflows must not become an undefined index later.
FINITE_MATH_OFF = {"contract", "reassoc", "arcp", "nsz", "afn"}
