"""The material point method, frame by frame: each is a differentiable function of torch."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid, Material, TimeStep
from gausim.baselines.mpm.particles import Particles, ParticleState, require_inside
from gausim.baselines.mpm.substeps import Substeps, Window, on_stream_of, views, warp
from gausim.core import DivergenceError

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


class MPMSolver:
    """MLS-MPM/APIC on quadratic B-splines, explicit (Hu et al. 2018, Jiang et al. 2015).

    All quantities are in simulation units and float32, on the device of the particles. A frame is differentiable
    with respect to the state at its start and Young's modulus.
    """

    def __init__(self, particles: Particles, material: Material, grid: Grid, step: TimeStep) -> None:
        self.particles, self.material, self.grid, self.step = particles, material, grid, step
        self._substeps = Substeps(particles, material, grid)

    def substeps(self, young_modulus: Float[Tensor, " N"]) -> int:
        """Substeps per frame for these moduli."""
        density = self.particles.mass / self.particles.volume
        return self.step.count(self.grid.dx, young_modulus, density, self.material.poisson_ratio)

    def advance(self, state: ParticleState, frame: int, *, young_modulus: Float[Tensor, " N"]) -> ParticleState:
        """The state at the end of a frame.

        Args:
            state: the state at its start.
            frame: its number, counted from 0, for error messages.
            young_modulus: E per particle.

        Raises:
            DivergenceError: a particle left the domain or is not finite.
        """
        count = self.substeps(young_modulus)
        tensors = (*state.tensors(), young_modulus.float())
        keep = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        dt = self.step.frame_time / count
        following = ParticleState(*Frame.apply(self._substeps, count, dt, self.grid.dx, keep, *tensors))
        self._check(following, frame + 1)
        return following

    def _check(self, state: ParticleState, frame: int) -> None:
        require_inside(state.positions.detach(), self.grid, f"frame {frame}")
        finite = torch.isfinite(state.deformation_gradients.detach()).flatten(1).all(1)
        if not finite.all():
            first = int((~finite).nonzero()[0])
            place = ", ".join(f"{value:.4g}" for value in state.positions[first].tolist())
            raise DivergenceError(
                f"material points, frame {frame}: the deformation gradient of particle {first} at ({place}) is not "
                "finite. The simulation blew up: take more substeps (a smaller Courant number) or a softer material."
            )
