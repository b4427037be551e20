"""A differentiable material point method (MLS-MPM with APIC) on NVIDIA Warp, shared by PhysGaussian and PhysDreamer.

Warp is imported when the first solver is made, not before. A scene rolled out with given material:

    dynamics = MPMDynamics(scene, fps=24.0, material=Material(young_modulus=1e5), grid=Grid(cells=50, size=2.0))
    trajectory = dynamics.rollout(SimState(positions, previous), steps=50)

and a frame that carries gradients, for whoever fits velocities or moduli:

    dynamics = dynamics.with_young_modulus(log_young.exp())
    state = dynamics.advance(dynamics.start(initial), frame=0)  # state.detach() ends the gradients there
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
