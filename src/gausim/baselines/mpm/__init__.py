"""A differentiable material point method (MLS-MPM with APIC) on NVIDIA Warp, shared by PhysGaussian and PhysDreamer.

Warp is imported when the first solver is made, not before. Elastic particles that move for a frame:

    solver = MPMSolver(Particles.create(x, grid=grid, density=200.0, pinned=pinned), Material(), grid, TimeStep(1 / 24))
    state = solver.advance(ParticleState.at_rest(x, velocities), frame=0, young_modulus=E)
"""

from gausim.baselines.mpm.config import Grid, Material, Slope, TimeStep
from gausim.baselines.mpm.filling import Filling, fill_interior
from gausim.baselines.mpm.particles import Particles, ParticleState
from gausim.baselines.mpm.solver import MPMSolver

__all__ = [
    "Filling",
    "Grid",
    "MPMSolver",
    "Material",
    "ParticleState",
    "Particles",
    "Slope",
    "TimeStep",
    "fill_interior",
]
