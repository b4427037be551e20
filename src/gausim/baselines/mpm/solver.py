"""The material point method, frame by frame."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.mpm.adjoint import Frame
from gausim.baselines.mpm.config import Grid, Material, TimeStep
from gausim.baselines.mpm.particles import Particles, ParticleState, require_inside
from gausim.baselines.mpm.substeps import Substeps
from gausim.core import DivergenceError


class MPMSolver:
    """MLS-MPM/APIC on quadratic B-splines, explicit (Hu et al. 2018, Jiang et al. 2015).

    All quantities are in simulation units and float32, on the device of the particles. A frame is differentiable
    with respect to the state at its start and Young's modulus; :meth:`ParticleState.detach` stops loss gradients
    there.
    """

    def __init__(self, particles: Particles, material: Material, grid: Grid, step: TimeStep) -> None:
        self.particles, self.material, self.grid, self.step = particles, material, grid, step
        self._substeps = Substeps(particles, material, grid)

    def substeps(self, young_modulus: Float[Tensor, " N"]) -> int:
        """Substeps per frame for these moduli.

        Raises:
            ConfigError: the configured number violates the bound of the time step.
        """
        density = self.particles.mass / self.particles.volume
        return self.step.count(self.grid.dx, young_modulus, density, self.material.poisson_ratio)

    def advance(
        self, state: ParticleState, frame: int, *, young_modulus: Float[Tensor, " N"] | None = None
    ) -> ParticleState:
        """The state at the end of a frame.

        Args:
            state: the state at its start.
            frame: its number, counted from 0, for error messages.
            young_modulus: E per particle; the material's if not given.

        Raises:
            ConfigError: the configured number of substeps violates the bound of the time step.
            DivergenceError: a particle left the domain or is not finite.
        """
        if young_modulus is None:
            young_modulus = state.positions.new_full((len(state.positions),), self.material.young_modulus)
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
