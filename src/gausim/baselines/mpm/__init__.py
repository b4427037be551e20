"""A differentiable material point method (MLS-MPM with APIC) on NVIDIA Warp, shared by PhysGaussian and PhysDreamer.

Warp is imported when the first solver is made, not before.
"""

from gausim.baselines.mpm.conditions import Box, Conditions, Impulse, PrescribedMotion, pinned_box
from gausim.baselines.mpm.config import Grid, Material, MaterialKind, TimeStep
from gausim.baselines.mpm.dynamics import MPMDynamics
from gausim.baselines.mpm.filling import Filling, fill_interior
from gausim.baselines.mpm.mapping import SceneMapping
from gausim.baselines.mpm.particles import Particles, ParticleState, particle_volumes
from gausim.baselines.mpm.solver import MPMSolver

__all__ = [
    "Box",
    "Conditions",
    "Filling",
    "Grid",
    "MPMDynamics",
    "Impulse",
    "MPMSolver",
    "Material",
    "MaterialKind",
    "ParticleState",
    "Particles",
    "PrescribedMotion",
    "SceneMapping",
    "TimeStep",
    "fill_interior",
    "particle_volumes",
    "pinned_box",
]
