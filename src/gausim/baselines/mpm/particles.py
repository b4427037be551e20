"""Particles: constants (mass, volume, pins) and the state that moves."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid
from gausim.core import DivergenceError

HALF = 0.999  # below 1, so that a node half way between pinned and free matter is pinned despite rounding


@dataclass(frozen=True, eq=False)
class ParticleState:
    """The state of N particles between two substeps [simulation units]."""

    positions: Float[Tensor, "N 3"]  # x
    velocities: Float[Tensor, "N 3"]  # v
    affine: Float[Tensor, "N 3 3"]  # C, the velocity gradient of APIC [1 / s]
    deformation_gradients: Float[Tensor, "N 3 3"]  # F

    @staticmethod
    def at_rest(positions: Float[Tensor, "N 3"], velocities: Float[Tensor, "N 3"] | None = None) -> "ParticleState":
        """Undeformed particles (F = I, C = 0), at rest unless velocities are given."""
        x = positions.float()
        return ParticleState(
            x,
            torch.zeros_like(x) if velocities is None else velocities.float(),
            x.new_zeros(len(x), 3, 3),
            torch.eye(3, device=x.device).repeat(len(x), 1, 1),
        )

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(x, v, C, F)."""
        return self.positions, self.velocities, self.affine, self.deformation_gradients


@dataclass(frozen=True, eq=False)
class Particles:
    """Constants of a simulation."""

    mass: Float[Tensor, " N"]  # m [simulation units]
    volume: Float[Tensor, " N"]  # V at rest [simulation units^3]
    # particles that keep their position. Their F still changes: without it the layer between the last pinned node
    # and the first free one would be soft
    pinned: Bool[Tensor, " N"]
    # nodes of velocity 0: the nearest of each pinned particle, and those of whose mass at rest at least half
    # belongs to pinned particles
    pinned_nodes: Bool[Tensor, "n n n"]

    @staticmethod
    def create(
        positions: Float[Tensor, "N 3"], *, grid: Grid, density: float, pinned: Bool[Tensor, " N"]
    ) -> "Particles":
        """Particles at rest; those in a cell divide its volume equally.

        Raises:
            DivergenceError: a particle lies outside the domain.
        """
        require_inside(positions, grid, "at rest")
        volume = particle_volumes(positions, grid)
        nodes = torch.zeros((grid.cells + 1,) * 3, dtype=torch.bool, device=positions.device)
        if pinned.any():
            held = node_volumes(positions[pinned], volume[pinned], grid)
            nodes = (held > 0) & (held > HALF * node_volumes(positions[~pinned], volume[~pinned], grid))
            nodes[tuple((positions[pinned] / grid.dx).round().long().T)] = True
        return Particles(density * volume, volume, pinned, nodes)


def node_volumes(positions: Float[Tensor, "N 3"], volume: Float[Tensor, " N"], grid: Grid) -> Float[Tensor, "n n n"]:
    """Volume of the particles at every node, by quadratic B-splines [simulation units^3]."""
    n = grid.cells + 1
    base = (positions / grid.dx - 0.5).floor()
    f = positions / grid.dx - base
    weights = torch.stack((0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2))
    i, j, k = base.long().unbind(-1)
    total = volume.new_zeros(n**3)
    for a, b, c in itertools.product(range(3), repeat=3):
        part = volume * weights[a, :, 0] * weights[b, :, 1] * weights[c, :, 2]
        total.index_add_(0, ((i + a) * n + j + b) * n + k + c, part)
    return total.view(n, n, n)


def particle_volumes(positions: Float[Tensor, "N 3"], grid: Grid) -> Float[Tensor, " N"]:
    """V = dx^3 / number of particles in the particle's cell [simulation units^3] (PhysGaussian)."""
    i, j, k = (positions / grid.dx).floor().long().unbind(-1)
    cell = (i * grid.cells + j) * grid.cells + k
    _, inverse, count = torch.unique(cell, return_inverse=True, return_counts=True)
    return grid.dx**3 / count[inverse].float()


def require_inside(positions: Float[Tensor, "N 3"], grid: Grid, when: str) -> None:
    """Raises :class:`DivergenceError` naming the first particle whose 27 nodes are not all on the grid.

    The allowed region is half a cell less than the domain on each side; ``when`` is the time, e.g. 'frame 12'.
    """
    low, high = 0.5 * grid.dx, grid.size - 0.5 * grid.dx
    outside = ~((positions >= low) & (positions < high)).all(-1)
    if not outside.any():
        return
    first = int(outside.nonzero()[0])
    place = ", ".join(f"{value:.4g}" for value in positions[first].tolist())
    if torch.isfinite(positions[first]).all():
        remedy = "Enlarge the domain or scale the scene down in it, or make the motion smaller."
    else:
        remedy = "The simulation blew up: take more substeps (a smaller Courant number) or a softer material."
    raise DivergenceError(
        f"material points, {when}: particle {first} is at ({place}); expected every coordinate in "
        f"[{low:.4g}, {high:.4g}) of the domain [0, {grid.size:.4g}]^3 ({int(outside.sum())} of {len(positions)} are "
        f"outside). {remedy}"
    )
