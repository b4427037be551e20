"""One frame, many substeps, as one differentiable function of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gausim.baselines.mpm.runtime import on_stream_of, warp
from gausim.baselines.mpm.substeps import State, Substeps, Window

STATE = 4  # tensors of a particle state


@dataclass(frozen=True, eq=False)
class FramePlan:
    """How a frame is made.

    Attributes:
        substeps: launches the kernels.
        count: substeps.
        dt: duration of each [s].
        dx: edge of a cell [simulation units].
        keep: whether a backward pass will come.
    """

    substeps: Substeps
    count: int
    dt: float
    dx: float
    keep: bool


class Frame(torch.autograd.Function):
    """(x, v, C, F, E, a) at the start of a frame -> (x, v, C, F) at its end.

    With gradients wanted, the state of every substep is kept until the backward pass, 24 numbers per particle; grids
    and stresses are computed again there. Otherwise two states are kept.
    """

    @staticmethod
    def forward(ctx: Any, plan: FramePlan, *given: Tensor) -> tuple[Tensor, ...]:
        """Makes the frame; again on the whole grid if a particle leaves the window round where they began."""
        given = tuple(t.detach().contiguous() for t in given)
        window = plan.substeps.window(given[0])
        history = _run(plan, window, given)
        last = plan.count % len(history[0])
        if not window.holds(history[0][last], plan.dx):
            window = plan.substeps.window()
            history = _run(plan, window, given)
        if plan.keep:
            ctx.plan, ctx.window = plan, window
            ctx.save_for_backward(*given[STATE:], *history)
        return tuple(h[last].clone() for h in history)

    @staticmethod
    def backward(ctx: Any, *adjoints: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Goes through the substeps backwards."""
        plan: FramePlan = ctx.plan
        young, acceleration, *history = ctx.saved_tensors
        tensors = tuple(a.float().contiguous().clone() for a in adjoints)
        other = tuple(torch.empty_like(t) for t in tensors)
        adjoint_young, adjoint_acceleration = torch.zeros_like(young), torch.zeros_like(acceleration)
        with on_stream_of(young.device):
            E, a = _young_and_acceleration(young, acceleration)
            adjoint_E, adjoint_a = _young_and_acceleration(adjoint_young, adjoint_acceleration)
            given, found = State.of(tensors), State.of(other)
            windows = ctx.window, Window(ctx.window.origin, ctx.window.shape, plan.substeps.device)
            following = State.of(tuple(h[plan.count] for h in history))
            for s in reversed(range(plan.count)):
                now = State.of(tuple(h[s] for h in history))
                states, pair = (now, following), (found, given)
                plan.substeps.backward(windows, states, pair, (E, adjoint_E), (a, adjoint_a), plan.dt)
                given, found, following = found, given, now
        final = tensors if plan.count % 2 == 0 else other
        return (None, *final, adjoint_young, adjoint_acceleration)


def _run(plan: FramePlan, window: Window, given: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """All states of the frame (or the latest two), per tensor of the state, in slots substep % slots."""
    slots = plan.count + 1 if plan.keep else 2
    first, (young, acceleration) = given[:STATE], given[STATE:]
    history = tuple(t.new_empty(slots, *t.shape) for t in first)
    for kept, tensor in zip(history, first, strict=True):
        kept[0] = tensor
    with on_stream_of(young.device):
        states = [State.of(tuple(h[s] for h in history)) for s in range(slots)]
        E, a = _young_and_acceleration(young, acceleration)
        for s in range(plan.count):
            now, following = states[s % slots], states[(s + 1) % slots]
            plan.substeps.forward(window, now, following, E, a, plan.dt)
    return history


def _young_and_acceleration(young: Tensor, acceleration: Tensor) -> tuple[Any, Any]:
    wp = warp()
    return wp.from_torch(young), wp.from_torch(acceleration, dtype=wp.vec3)
