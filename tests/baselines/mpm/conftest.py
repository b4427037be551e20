"""Blocks of particles in small domains."""

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor


@pytest.fixture(scope="session")
def lattice() -> Callable[[Sequence[float], Sequence[float], float], Tensor]:
    """Positions of a block from one corner to the other, each in the middle of a cube of the given edge."""

    def make(lower: Sequence[float], upper: Sequence[float], spacing: float) -> Tensor:
        counts = [round((b - a) / spacing) for a, b in zip(lower, upper, strict=True)]
        axes = [a + spacing * (torch.arange(n) + 0.5) for a, n in zip(lower, counts, strict=True)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    return make
