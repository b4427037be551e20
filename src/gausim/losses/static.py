"""Static loss: a body at rest stays at rest (METHOD section 4)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def static_loss(
    positions: Float[Tensor, "K 3"], rest: Float[Tensor, "K 3"], diagonal: Float[Tensor, "K 1"]
) -> Float[Tensor, ""]:
    """Sum over kernels of the squared distance between one step from the rest state and the rest state.

    Lengths are divided by the diagonal of each kernel's scene, so the loss is independent of the scene's unit.
    """
    return ((positions - rest) / diagonal).square().sum()
