"""The oracle's gradients against finite differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gausim.render.reference import ReferenceRenderer


def test_gradcheck_with_respect_to_all_inputs(inputs: Callable) -> None:
    """Kernels wide enough that some means lie where the projection is clamped, two states, two views."""
    given = inputs(2, 2, 3, (5, 4), scale=0.25, spread=0.6, seed=3).to(torch.float64)
    given.opacities[:, 0] = 0.97  # below the ceiling: at it the derivative is one-sided

    def images(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        names = "means", "covars", "colors", "opacities", "background"
        drawn = replace(given, depth=True, **dict(zip(names, tensors, strict=True))).draw(ReferenceRenderer())
        assert drawn.depth is not None
        return drawn.rgb, drawn.alpha, drawn.depth

    assert torch.autograd.gradcheck(images, tuple(x.requires_grad_() for x in given.tensors), atol=1e-6, fast_mode=True)
