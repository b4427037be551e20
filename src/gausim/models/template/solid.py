"""Vibration modes of the body that the kernels bound: linear elasticity on a regular grid around them.

Kernels lie on the visible surface of a solid body (:mod:`gausim.models.template.grid`). The mass is that of the units.
The resulting modes are smooth across gaps between kernels and across untextured regions.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from scipy.spatial import cKDTree

from gausim.models.template.grid import FIRST, SECOND, Grid, by_component, cells, matrix, rigid_motions, stiffness

# Number of units among which a cell is divided, by inverse squared distance.
CELL_UNITS = 4
# Stiffness of the springs that hold pinned kernels, relative to a grid cell.
PIN_STIFFNESS = 1e3
# Nodes at the rim with a stiffness below this fraction of the largest are left out: they are subject to rounding.
NO_SUPPORT = 1e-9
# Stiffness of springs on all nodes, as a fraction of the median: parts without a connection to a pin could move freely,
# and the equations would be singular.
FOUNDATION = 1e-8
# Displacements (D, ...) of a body under forces (D, ...).
Solver = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SolidSettings:
    """How the body around the kernels is modelled."""

    spacing: float = 0.08  # of the grid [diagonals]
    least: float = 1.7  # the grid's least spacing, in median distances of a kernel to its fourth neighbour
    held_inside: bool = True  # pinned kernels hold what is within the body beside them, too
    free_modes: int = 2  # times as many modes for a body that nothing holds: an impact deforms it where it touches

    def size(self, kernels: np.ndarray, diagonal: float) -> float:
        """Spacing of the grid of a body [scene units]: where kernels (K, 3) are sparse, a fine one has holes."""
        apart = cKDTree(kernels).query(kernels, k=min(5, len(kernels)))[0][:, -1] if self.least else np.zeros(1)
        return max(self.spacing * diagonal, self.least * float(np.median(apart)))


@dataclass(frozen=True, eq=False)
class SolidBody:
    """The lowest modes of a body as a field on a grid."""

    grid: Grid  # of the splines
    values: np.ndarray  # eigenvalues (M,), ascending
    field: np.ndarray  # coefficients (3, nodes, M) of the modes, orthonormal under the units' mass
    centres: np.ndarray  # of the integration cells (Q, 3) [scene units]
    weights: np.ndarray  # their volumes (Q,), outside the body times :data:`OUTSIDE` [scene units^3]
    vibrations: int  # modes that are vibrations; the others, above them, are modal derivatives

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Modes (P, 3, M) and displacement gradients (P, 3, 3, M) [1 / scene units] at points (P, 3)."""
        nodes, values, gradients = self.grid.splines(points)
        at = self.field[:, nodes]  # (3, P, 27, M)
        modes = np.einsum("nk,ankm->nam", values, at, optimize=True)
        return modes, np.einsum("nkb,ankm->nabm", gradients, at, optimize=True)

    @cached_property
    def cell_strain(self) -> np.ndarray:
        """Strain of the modes in every cell (Q, 3, 3, M) [1 / scene units]."""
        _, slope = self.at(self.centres)
        return (slope + slope.transpose(0, 2, 1, 3)) / 2

    def shares(self, rest: np.ndarray) -> sp.csr_matrix:
        """Volume (N, Q) of every cell that belongs to each of the units at ``rest`` (N, 3) [scene units^3]."""
        near, units = cKDTree(rest).query(self.centres, k=min(CELL_UNITS, len(rest)))
        near, units = near.reshape(len(self.centres), -1), units.reshape(len(self.centres), -1)
        parts = 1 / (near**2 + 1e-12)
        parts *= self.weights[:, None] / parts.sum(1, keepdims=True)
        cells = np.repeat(np.arange(len(units)), units.shape[1])
        return sp.csr_matrix((parts.ravel(), (units.ravel(), cells)), shape=(len(rest), len(units)))

    def strains(self, rest: np.ndarray) -> np.ndarray:
        """Strain of the modes in the cells near each unit, row by row, times their volume (N, 9, M), over lambda_1."""
        return (self.shares(rest) @ self.cell_strain.reshape(len(self.centres), -1)).reshape(
            len(rest), 9, -1
        ) / self.values[0]

    def cell_stiffness(self, rest: np.ndarray, pinned: np.ndarray) -> np.ndarray:
        """K_i and B_i (2, N, M, M): energy of shear and of volume of the cells near each unit, pinned ones included."""
        strain = self.cell_strain
        trace, count = np.trace(strain, axis1=1, axis2=2), strain.shape[-1]
        # Components per cell and mode whose squares sum to twice the energy: nine of shear, one of volume.
        parts = math.sqrt(2 * SECOND) * strain.reshape(-1, 9, count), math.sqrt(FIRST) * trace[:, None]
        found = np.zeros((2, len(rest), count, count))
        for unit, share in enumerate(self.shares(rest)):
            size = np.sqrt(share.data)[:, None, None]
            for total, roots in zip(found, parts, strict=True):
                part = (roots[share.indices] * size).reshape(-1, count)
                total[unit] = part.T @ part
        missing = np.diag(self.values) - found.sum((0, 1))  # the springs that hold the pins, and rounding
        free = ~pinned
        found[0, free] += missing / free.sum()
        return found

    def mean_gradients(self, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean displacement gradients of the modes in the cells near each unit (N, 9, M), and their volume (N,)."""
        shares = self.shares(rest)
        volume = np.asarray(shares.sum(1)).ravel()
        slopes = self.at(self.centres)[1].reshape(len(self.centres), -1)
        return (shares @ slopes / np.maximum(volume, 1e-30)[:, None]).reshape(len(rest), 9, -1), volume


def solid_body(
    kernels: np.ndarray,
    held: np.ndarray,
    rest: np.ndarray,
    mass: np.ndarray,
    pinned: np.ndarray,
    *,
    modes: int,
    spacing: float,
    inside: bool = True,
    curved: int = 0,
) -> SolidBody:
    """Lowest modes of the body around the kernels; of a body that nothing holds, without its six rigid motions.

    Args:
        kernels: rest positions (K, 3) [scene units].
        held: mask of the pinned kernels (K,).
        rest: rest positions of the units (N, 3) [scene units].
        mass: masses of the units (N,); the modes are orthonormal under them.
        pinned: mask of the pinned units (N,).
        modes: number of modes; at most three per free unit are returned. The largest component of each at a free
            unit is positive.
        spacing: spacing of the grid [scene units].
        inside: also hold what is nearest to pinned kernels within the body.
        curved: of so many of the lowest modes derivatives join the modes, up to half of them (:func:`derivatives`).
    """
    body = _assembled(kernels, held, spacing, inside=inside)
    grid, whole = body.grid, body.stiffness
    used = whole.diagonal() > 0
    nodes, values, _ = grid.splines(rest[~pinned])
    carry = sp.block_diag([matrix(nodes, values, grid.size)] * 3).tocsr()[:, used]
    root = np.tile(np.sqrt(mass[~pinned]), 3)
    rigid = None if held.any() else grid.rigid_coefficients()[used]
    whole, carry = whole[used][:, used], sp.diags(root) @ carry
    solve = _solver(whole)

    def body_of(eigenvalues: np.ndarray, vectors: np.ndarray, vibrations: int) -> SolidBody:
        # The signs of eigenvectors differ between machines. What is trained in the modes must mean the same on all.
        moved = carry @ vectors
        signs = np.sign(moved[np.abs(moved).argmax(0), np.arange(moved.shape[1])])
        field = np.zeros((3 * grid.size, vectors.shape[1]))
        field[used] = vectors * signs
        return SolidBody(grid, eigenvalues, field.reshape(3, grid.size, -1), body.centres, body.weights, vibrations)

    eigenvalues, vectors = lowest(solve, carry, modes, rigid)
    vibrating = body_of(eigenvalues, vectors, len(eigenvalues))
    if not curved:
        return vibrating
    return body_of(*_joined(vectors, derivatives(vibrating, curved, solve, used, carry, rigid), whole, carry))


def derivatives(
    body: SolidBody, count: int, solve: Solver, used: np.ndarray, carry: sp.spmatrix, rigid: np.ndarray | None
) -> np.ndarray:
    """Modal derivatives (D, P): static answers to the second-order forces of pairs of the ``count`` lowest modes.

    ``solve`` gives displacements (D, ...) of forces.

    A body that bends far also shortens; linear modes cannot say so, and finite strain in them is far too stiff. What
    is missing solves K x = -Q(H_i, H_j), Q the part of the forces of finite strain that is quadratic in the
    displacement gradients H (Idelsohn and Cardona 1985; Barbic and James 2005, whose weights these have).
    """
    nodes, _, gradients = body.grid.splines(body.centres)
    slopes = [matrix(nodes, gradients[..., a], body.grid.size) for a in range(3)]
    h = np.moveaxis(body.at(body.centres)[1][..., :count], -1, 0)  # (count, Q, 3, 3)
    stress = [_stress(x) for x in h]
    loads = []
    for i, j in itertools.combinations_with_replacement(range(len(h)), 2):
        force = _stress(h[i].transpose(0, 2, 1) @ h[j]) + h[i] @ stress[j] + h[j] @ stress[i]
        force *= body.weights[:, None, None]
        load = -np.concatenate([sum(slopes[b].T @ force[:, a, b] for b in range(3)) for a in range(3)])[used]
        if rigid is not None:  # free of what would accelerate the whole body
            moved = carry @ rigid
            load -= carry.T @ (moved @ np.linalg.solve(moved.T @ moved, rigid.T @ load))
        loads.append(load / np.sqrt(body.values[i] * body.values[j]))
    x = solve(np.stack(loads, 1))
    if rigid is not None:
        x -= rigid @ np.linalg.lstsq(carry @ rigid, carry @ x, rcond=None)[0]
    return x


def _stress(gradient: np.ndarray) -> np.ndarray:
    """Hooke's stress (Q, 3, 3) of the symmetric part of displacement gradients, at Young's modulus 1."""
    trace = np.trace(gradient, axis1=1, axis2=2)[:, None, None]
    return FIRST * trace * np.eye(3) + SECOND * (gradient + gradient.transpose(0, 2, 1))


def _joined(
    vectors: np.ndarray, bent: np.ndarray, whole: sp.spmatrix, carry: sp.spmatrix
) -> tuple[np.ndarray, np.ndarray, int]:
    """Eigenvalues and vectors, as many as ``vectors``, of the lowest of them and the largest parts of ``bent``.

    The last value counts those of ``vectors`` among them. They come first: what is orthogonal to the lowest vibrations
    has larger eigenvalues.
    """
    more = min(bent.shape[1], vectors.shape[1] // 2)
    kept = vectors[:, : vectors.shape[1] - more]
    bent = bent - kept @ ((carry @ kept).T @ (carry @ bent))
    _, sizes, parts = np.linalg.svd(carry @ bent, full_matrices=False)
    more = min(more, int((sizes > 1e-6 * sizes[0]).sum()))
    basis = np.concatenate((kept, bent @ parts[:more].T / sizes[:more]), 1)
    moved = carry @ basis
    values, turned = eigh(basis.T @ (whole @ basis), moved.T @ moved)
    return values, basis @ turned, kept.shape[1]


@dataclass(frozen=True, eq=False)
class _Assembled:
    """Equations of a body that springs hold at its pinned kernels and, inside, in the cells nearest to them."""

    grid: Grid
    centres: np.ndarray  # of the integration cells (Q, 3) [scene units]
    weights: np.ndarray  # their volumes (Q,), see :class:`SolidBody`
    stiffness: sp.csr_matrix  # of cells and springs; rows and columns of unused nodes are zero
    places: np.ndarray  # where springs hold the body (P, 3) [scene units]
    holders: np.ndarray  # the pinned kernel that moves with each (P,)
    force: sp.csr_matrix  # of the springs on the nodes per motion (P, 3) of the places, component by component


def _assembled(kernels: np.ndarray, held: np.ndarray, spacing: float, *, inside: bool = True) -> _Assembled:
    grid, centres, weights = cells(kernels, spacing)
    blocks = stiffness(grid, centres, weights)
    force = sp.csr_matrix((3 * grid.size, 0))
    places, holders = kernels[held], np.flatnonzero(held)
    if inside and held.any():  # what is held is not a shell either: kernels only show the surface of it
        solid = centres[weights == weights.max()]
        nearest = cKDTree(kernels).query(solid)[1]
        inner = held[nearest]
        places, holders = np.concatenate((places, solid[inner])), np.concatenate((holders, nearest[inner]))
    if held.any():
        nodes, values, _ = grid.splines(places)
        hold = matrix(nodes, values, grid.size)
        strength = PIN_STIFFNESS * weights.sum() / (len(places) * spacing**2)
        for a in range(3):
            blocks[a][a] = blocks[a][a] + strength * (hold.T @ hold)
        force = strength * sp.block_diag([hold.T] * 3).tocsr()
    whole = sp.bmat(blocks).tocsr()
    used = whole.diagonal() > NO_SUPPORT * whole.diagonal().max()
    whole = whole + FOUNDATION * np.median(whole.diagonal()[used]) * sp.identity(whole.shape[0])
    keep = sp.diags(used.astype(np.float64))
    return _Assembled(grid, centres, weights, (keep @ whole @ keep).tocsr(), places, holders, (keep @ force).tocsr())


def static_responses(
    kernels: np.ndarray, hand: np.ndarray, points: np.ndarray, *, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Static displacements of a homogeneous body whose pins are moved rigidly, hand by hand, by small amounts.

    The static modes of component mode synthesis (Craig and Bampton 1968); together with the vibration modes of the
    pinned body they describe a body whose pins move.

    Args:
        kernels: rest positions (K, 3) [scene units].
        hand: the hand that holds each kernel (K,), 0..G-1; -1 for free kernels.
        points: rest positions (P, 3) at which the responses are wanted [scene units].
        spacing: spacing of the grid [scene units].

    Returns:
        Centre of every hand's kernels (G, 3), displacements (P, 3, G, 6) of the points and their gradients
        (P, 3, 3, G, 6) [1 / scene units] per unit translation along and rotation about each axis through that centre.
    """
    body = _assembled(kernels, hand >= 0, spacing)
    grid, whole, of = body.grid, body.stiffness, hand[body.holders]
    used = whole.diagonal() > 0
    solve = _solver(whole[used][:, used])
    count = int(hand.max()) + 1
    centres = np.stack([kernels[hand == g].mean(0) for g in range(count)])
    field = np.zeros((3 * grid.size, count, 6))
    for g in range(count):
        loads = body.force @ by_component(rigid_motions(body.places - centres[g]) * (of == g)[:, None, None])
        field[used, g] = solve(loads[used])
    nodes, values, gradients = grid.splines(points)
    at = field.reshape(3, grid.size, count, 6)[:, nodes]
    moved = np.einsum("pn,apngc->pagc", values, at, optimize=True)
    return centres, moved, np.einsum("pnb,apngc->pabgc", gradients, at, optimize=True)


def _solver(k: sp.spmatrix) -> Solver:
    """Displacements (D, ...) of a body of stiffness k, symmetric and positive, under forces."""
    symmetric = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return cast(Solver, splu(k.tocsc(), **symmetric).solve)


def lowest(
    solve: Solver, carry: sp.spmatrix, count: int, rigid: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Smallest eigenvalues (M,) and vectors (D, M) of k x = value carry^T carry x, with carry x orthonormal.

    ``solve`` gives k^-1 of forces. The mass carry^T carry has a small rank R, so the R x R matrix of compliances
    carry k^-1 carry^T is solved instead: its largest eigenvalues are the inverses. Vectors are orthogonal to ``rigid``
    motions (D, 6), if there are any: loads are freed of them beforehand, displacements afterwards (inertia relief).
    """
    rank, turned = carry.shape[0], carry.T.tocsc()
    whole = np.zeros((rank, 0)) if rigid is None else np.linalg.qr(carry @ rigid)[0]
    count = min(count, rank - whole.shape[1])

    def elastic(x: np.ndarray) -> np.ndarray:
        return x - whole @ (whole.T @ x)

    def comply(x: np.ndarray) -> np.ndarray:
        return elastic(carry @ solve(turned @ elastic(x)))

    if rank <= max(400, 2 * count):
        compliance = comply(np.eye(rank))
        inverse, found = eigh((compliance + compliance.T) / 2)
    else:
        operator = LinearOperator((rank, rank), matvec=comply, dtype=np.float64)
        inverse, found = eigsh(operator, count, which="LM", v0=np.ones(rank))
    order = np.argsort(inverse)[::-1][:count]
    inverse, found = inverse[order], found[:, order]
    kept = inverse > 1e-12 * inverse[0]
    inverse, found = inverse[kept], found[:, kept]
    vectors = solve(turned @ found) / inverse
    if rigid is not None:
        vectors -= rigid @ np.linalg.lstsq(carry @ rigid, carry @ vectors, rcond=None)[0]
    return 1 / inverse, vectors
