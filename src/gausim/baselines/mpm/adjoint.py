"""One frame of substeps as a differentiable function of torch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gausim.baselines.mpm.runtime import on_stream_of, warp
from gausim.baselines.mpm.substeps import Substeps, Window, views

STATE = 4  # tensors of a particle state


class Frame(torch.autograd.Function):
    """(x, v, C, F, E) at the start of a frame -> (x, v, C, F) at its end, after ``count`` substeps of ``dt`` [s].

    With ``keep``, for loss gradients, the state of every substep is kept until the backward pass, 24 numbers per
    particle; grids and stresses are recomputed there. Otherwise two states are kept.
    """

    @staticmethod
    def forward(
        ctx: Any, substeps: Substeps, count: int, dt: float, dx: float, keep: bool, *given: Tensor
    ) -> tuple[Tensor, ...]:
        """Computes the frame, and once more on the whole grid if a particle leaves the window."""
        given = tuple(t.detach().contiguous() for t in given)
        slots = count + 1 if keep else 2
        window = substeps.window(given[0])
        history = _run(substeps, window, given, slots, count, dt)
        last = count % slots
        if not window.holds(history[0][last], dx):
            window = substeps.window()
            history = _run(substeps, window, given, slots, count, dt)
        if keep:
            ctx.substeps, ctx.count, ctx.dt, ctx.nodes = substeps, count, dt, (window.origin, window.shape)
            ctx.save_for_backward(given[STATE], *history)
        return tuple(h[last].clone() for h in history)

    @staticmethod
    def backward(ctx: Any, *adjoints: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """The adjoints of the substeps in reverse order."""
        substeps, count = ctx.substeps, ctx.count
        young, *history = ctx.saved_tensors
        tensors = tuple(a.float().contiguous().clone() for a in adjoints)
        other = tuple(torch.empty_like(t) for t in tensors)
        adjoint_young = torch.zeros_like(young)
        with on_stream_of(young.device):
            E = warp().from_torch(young, grad=adjoint_young)
            origin, shape = ctx.nodes
            window = Window(origin, shape, substeps.device, adjoint=True)
            adjoint_found, adjoint_given = views(other), views(tensors)
            following = views([h[count] for h in history])
            for s in reversed(range(count)):
                now = views([h[s] for h in history])
                for array, adjoint in zip((*now, *following), (*adjoint_found, *adjoint_given), strict=True):
                    array.grad = adjoint
                substeps.backward(window, now, following, E, ctx.dt)
                adjoint_found, adjoint_given, following = adjoint_given, adjoint_found, now
        return (*[None] * 5, *(tensors if count % 2 == 0 else other), adjoint_young)


def _run(
    substeps: Substeps, window: Window, given: tuple[Tensor, ...], slots: int, count: int, dt: float
) -> tuple[Tensor, ...]:
    """All states of the frame, or the latest two, per tensor of the state, in slots substep % slots."""
    first, young = given[:STATE], given[STATE]
    history = tuple(t.new_empty(slots, *t.shape) for t in first)
    for kept, tensor in zip(history, first, strict=True):
        kept[0] = tensor
    with on_stream_of(young.device):
        states = [views([h[s] for h in history]) for s in range(slots)]
        E = warp().from_torch(young)
        for s in range(count):
            substeps.forward(window, states[s % slots], states[(s + 1) % slots], E, dt)
    return history
