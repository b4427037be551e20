"""When the operations compiled by numba stand in for chains of torch operations.

A step is made of hundreds of operations on small arrays; on a processor most of its time is their overhead. The chains
are therefore written out once more, compiled, with their gradients, for float32 on the CPU. The torch forms serve every
other device and type and are what the compiled ones are tested against.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

_switched_on = True


def fits(*tensors: Tensor) -> bool:
    """Whether compiled operations can take these tensors: float32 on the CPU, in eager mode."""
    if not _switched_on or torch.compiler.is_compiling():
        return False
    return all(t.dtype is torch.float32 and t.device.type == "cpu" for t in tensors)


@contextmanager
def torch_only() -> Iterator[None]:
    """Runs a block by the torch forms alone; for comparisons."""
    global _switched_on
    before, _switched_on = _switched_on, False
    try:
        yield
    finally:
        _switched_on = before


def array(tensor: Tensor) -> np.ndarray:
    """The tensor's numbers as a contiguous array, without a copy where it is contiguous already."""
    return tensor.detach().contiguous().numpy()
