"""Material of the cells of a body, and its modes by small displacements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import eigsh

from data_prep.random_bodies.plan import CONTRASTS, DAMPING_RATIOS, DENSITIES, HALVES, POISSON_RATIOS
from data_prep.random_bodies.shapes import Rng
from data_prep.synthetic.bodies import Array, Body, tet_volumes
from gausim.core import DivergenceError


@dataclass(frozen=True, eq=False)
class Matter:
    """Elastic material, per cell."""

    kind: str  # ``even``, ``split`` (two materials), ``halves`` (two stiffnesses, across the body) or ``smooth``
    contrast: float  # largest stiffness over the smallest
    poisson_ratio: float
    young_modulus: Array  # (C,) [mass / (scene unit s^2)]
    density: Array  # (C,) [mass / scene unit^3]
    drag: Array  # (C,) force over momentum [1/s]

    def node_masses(self, body: Body) -> Array:
        """(N,) a quarter of each adjoining tetrahedron."""
        tets = body.tetrahedra
        quarter = tet_volumes(body.nodes, tets) * np.tile(self.density, 6) / 4
        return np.bincount(tets.ravel(), np.repeat(quarter, 4), len(body.nodes)).astype(float)

    def node_drag(self, body: Body) -> Array:
        """(N,) mean of the adjoining cells [1/s]."""
        corners = body.cells.ravel()
        return np.bincount(corners, np.repeat(self.drag, 8)) / np.bincount(corners)


@dataclass(frozen=True, eq=False)
class Modes:
    """Slowest modes of a body with held nodes, slowest first."""

    omega: Array  # (M,) angular frequencies [1/s]
    shapes: Array  # (M, N, 3), orthonormal in the masses
    highest: float  # angular frequency of the fastest mode of all [1/s]


def random_matter(body: Body, rng: Rng, *, kinds: Sequence[str]) -> Matter:
    """Material whose stiffness and drag are relative, their means 1; even where two halves come out as one."""
    kind = str(rng.choice(kinds))
    middle = body.nodes[body.cells].mean(1)
    direction = rng.normal(size=3)
    along = (middle - middle[rng.integers(len(middle))]) @ (direction / np.linalg.norm(direction)) / body.diagonal
    if kind == "halves":
        place = middle[:, np.ptp(middle, axis=0).argmax()]
        level = (rng.choice([-1, 1]) * (place - np.quantile(place, rng.uniform(*HALVES))) > 0).astype(float)
    elif kind == "smooth":
        wave = np.sin(rng.uniform(2, 6) * along + rng.uniform(0, 6))
        level = (wave - wave.min()) / np.ptp(wave)
    else:
        level = (along > 0).astype(float) * (kind == "split")
    if np.ptp(level) == 0:
        kind = "even"
    contrast = float(np.exp(rng.uniform(*np.log(CONTRASTS))))
    density, drag = rng.uniform(-1, 1) * np.log(3), rng.uniform(-1, 1) * np.log(4)
    if kind == "halves":
        density = drag = 0.0
    young = contrast**level
    return Matter(
        kind=kind, contrast=float(young.max() / young.min()), poisson_ratio=float(rng.uniform(*POISSON_RATIOS)),
        young_modulus=young / np.exp(np.log(young).mean()),
        density=np.exp(density * (level - level.mean())) * np.exp(rng.uniform(*np.log(DENSITIES))),
        drag=np.exp(drag * (level - level.mean())),
    )  # fmt: skip


def random_drag(omega: float, rng: Rng) -> float:
    """Of a mode whose damping ratio is random [1/s]."""
    return float(2 * omega * np.exp(rng.uniform(*np.log(DAMPING_RATIOS))))


def modes_of(body: Body, matter: Matter, count: int) -> Modes:
    """Modes of linear elasticity on linear tetrahedra with lumped masses.

    Raises:
        DivergenceError: they are not found, as where a part hangs by a hinge.
    """
    free = np.flatnonzero(np.repeat(~body.held, 3))
    root = 1 / np.sqrt(np.repeat(matter.node_masses(body), 3)[free])
    matrix = _stiffness(body, matter)[free][:, free]
    scaled = diags_array(root) @ matrix @ diags_array(root)
    start = np.random.default_rng(0).normal(size=len(free))  # ARPACK would take another one every time
    try:
        values, vectors = eigsh(scaled.tocsc(), k=min(count, len(free) - 2), sigma=0, v0=start)
        highest = eigsh(scaled, k=1, v0=start, tol=1e-2, return_eigenvectors=False)[0]
    except RuntimeError as error:  # ARPACK's errors and a singular matrix
        raise DivergenceError(f"the modes of the body are not found ({error}).") from error
    shapes = np.zeros((len(values), body.nodes.size))
    order = np.argsort(values)
    shapes[:, free] = (root[:, None] * vectors[:, order]).T
    return Modes(np.sqrt(np.abs(values[order])), shapes.reshape(-1, *body.nodes.shape), float(np.sqrt(highest)))


def _stiffness(body: Body, matter: Matter) -> coo_array:
    """(3 N, 3 N) stiffness matrix."""
    tets, nu = body.tetrahedra, matter.poisson_ratio
    x = body.nodes[tets]
    inverse = np.linalg.inv(x[:, 1:] - x[:, :1])  # its columns are the slopes of the last three shape functions
    slope = np.concatenate((-inverse.sum(2, keepdims=True), inverse), 2).transpose(0, 2, 1)  # (T, 4, 3)
    modulus = np.tile(matter.young_modulus, 6) * tet_volumes(body.nodes, tets) / (1 + nu)
    lam, mu = modulus * nu / (1 - 2 * nu), modulus / 2
    outer = np.einsum("tai,tbj->tabij", slope, slope)
    inner = np.einsum("tak,tbk->tab", slope, slope)[..., None, None] * np.eye(3)
    block = lam[:, None, None, None, None] * outer + mu[:, None, None, None, None] * (outer.swapaxes(3, 4) + inner)
    index = 3 * tets[:, :, None] + np.arange(3)  # (T, 4, 3)
    rows = np.broadcast_to(index[:, :, None, :, None], block.shape)
    columns = np.broadcast_to(index[:, None, :, None, :], block.shape)
    return coo_array((block.ravel(), (rows.ravel(), columns.ravel())), shape=(body.nodes.size,) * 2).tocsr()
