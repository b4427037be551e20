"""Operations with two forms: the plain one of torch, which is the reference, and a fast one compiled by numba.

A step is made of hundreds of operations on small arrays; on a processor most of its time is their overhead. A fast form
is such a chain written out once more, with its gradients, for float32 on the CPU. A method calls the operation by its
one name; which form serves a call is decided here and nowhere else. numba is imported when a fast form first serves.
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
OPERATIONS: dict[str, Operation[..., Any]] = {}


class Operation(Generic[P, R]):
    """A plain function that a fast form stands in for where it can.

    Attributes:
        plain: computes the result on every device and in every type, by torch.
        enabled: whether the fast form may serve.
    """

    def __init__(self, plain: Callable[P, R], fast: str) -> None:
        functools.update_wrapper(self, plain)
        self.plain, self.enabled, self._fast = plain, True, fast

    @functools.cached_property
    def fast(self) -> Callable[P, R]:
        """The fast form; takes what :attr:`plain` takes."""
        module, name = self._fast.split(":")
        found: Callable[P, R] = getattr(import_module(module), name)
        return found

    def __call__(self, *args: P.args, **options: P.kwargs) -> R:
        """The result, by the fast form where every tensor fits it."""
        if not self.fits(*args, **options):
            return self.plain(*args, **options)
        with announced(self._fast.split(":")[1].replace("_", " ")):
            return self.fast(*args, **options)

    def fits(self, *args: Any, **options: Any) -> bool:
        """Whether the fast form serves such a call: all on the CPU, every real number a float32, in eager mode."""
        if not self.enabled or torch.compiler.is_compiling():
            return False
        tensors = [value for value in (*args, *options.values()) if isinstance(value, Tensor)]
        return all(t.device.type == "cpu" and (t.dtype is torch.float32 or not t.is_floating_point()) for t in tensors)


def operation(fast: str) -> Callable[[Callable[P, R]], Operation[P, R]]:
    """Makes an operation of the plain function below; ``fast`` = ``module:function`` is imported late."""

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
    """The tensor's numbers as a contiguous array, without a copy where it is contiguous already."""
    return tensor.detach().contiguous().numpy()
