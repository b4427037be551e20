"""Operations with two forms: the plain one of torch, which is the reference, and a fast one compiled by numba.

A step consists of hundreds of operations on small arrays, whose overhead takes most of its time on a processor. A fast
form is one compiled function for a chain of them, with its adjoint, for float32 on the CPU. A method calls the
operation by its name; this module chooses the form of each call. numba is imported at the first call of a fast form.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from gausim.kernels.announce import announced

P = ParamSpec("P")
R = TypeVar("R")
# Constants of SSIM in both of its forms: (k L)^2 of Wang et al. 2004 with k = 0.01, 0.03 and L = 1.
SSIM_C1, SSIM_C2 = 1e-4, 9e-4
LEAST_SQUARE = 1e-6  # of a spring's length over that at rest, in both forms of its force
OPERATIONS: dict[str, Operation[..., Any]] = {}


class Operation(Generic[P, R]):
    """A plain function and the fast form that replaces it where its inputs allow.

    Attributes:
        plain: computes the result on every device and in every type, by torch.
        enabled: False forces the plain form.
    """

    def __init__(self, plain: Callable[P, R], fast: str) -> None:
        functools.update_wrapper(self, plain)
        self.plain, self.enabled, self._fast = plain, True, fast

    @functools.cached_property
    def fast(self) -> Callable[P, R]:
        """The fast form, which has the arguments of :attr:`plain`."""
        module, name = self._fast.split(":")
        found: Callable[P, R] = getattr(import_module(module), name)
        return found

    def __call__(self, *args: P.args, **options: P.kwargs) -> R:
        """The result, by the fast form where every tensor fits."""
        if not self.fits(*args, **options):
            return self.plain(*args, **options)
        with announced(self._fast.split(":")[1].replace("_", " ")):
            return self.fast(*args, **options)

    def fits(self, *args: Any, **options: Any) -> bool:
        """True if the fast form applies: all tensors on the CPU, floating ones in float32, and no torch.compile."""
        if not self.enabled or torch.compiler.is_compiling():
            return False
        tensors = [value for value in (*args, *options.values()) if isinstance(value, Tensor)]
        return all(t.device.type == "cpu" and (t.dtype is torch.float32 or not t.is_floating_point()) for t in tensors)


def operation(fast: str) -> Callable[[Callable[P, R]], Operation[P, R]]:
    """Makes an operation of the plain function below; ``fast`` = ``module:function`` is imported at the first call."""

    def register(plain: Callable[P, R]) -> Operation[P, R]:
        OPERATIONS[plain.__name__] = made = Operation(plain, fast)
        return made

    return register


@contextmanager
def plain_forms(names: Iterable[str] | None = None) -> Iterator[None]:
    """Runs a block by the plain forms of these operations, of all when None; for comparisons."""
    chosen = [OPERATIONS[name] for name in (OPERATIONS if names is None else names)]
    before = [made.enabled for made in chosen]
    for made in chosen:
        made.enabled = False
    try:
        yield
    finally:
        for made, enabled in zip(chosen, before, strict=True):
            made.enabled = enabled


def array(tensor: Tensor) -> np.ndarray:
    """The tensor as a contiguous array, without a copy where it is contiguous already."""
    return tensor.detach().contiguous().numpy()
