"""The static loss: what rests must stay at rest (METHOD section 4)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def static_loss(positions: Float[Tensor, "K 3"], rest: Float[Tensor, "K 3"]) -> Float[Tensor, ""]:
    """Sum over kernels of the squared distance between one step from the rest state and the rest state itself.

    In scene units squared; a plain sum, as METHOD section 4 has it.
    """
    return (positions - rest).square().sum()
