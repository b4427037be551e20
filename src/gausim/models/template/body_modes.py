"""The geometry of a scene in modal coordinates: what units and springs contribute to elastic energy and mass."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.solid import SolidBody, SolidSettings, solid_body
from gausim.models.template.springs import Springs, neighbour_pairs

# Lowest modes of which derivatives are among the modes of a body with finite strain: 21 of 48.
CURVED = 6
# Displacement per frame of the lowest mode at coordinate 1 of an initial velocity [diagonals].
AMPLITUDE = 0.05


class UnitModes(NamedTuple):
    """The modes of a homogeneous body at its units, in its own axes."""

    body: SolidBody
    rest: np.ndarray  # places of the units (N, 3) [scene units]
    pinned: np.ndarray  # which units are pinned (N,)
    mass: np.ndarray  # of the units, that of a free one 1 in the mean (N,)
    modes: np.ndarray  # (N, 3, M), zero at pinned units
    gradients: np.ndarray  # displacement gradients (N, 3, 3, M) [1 / scene units], zero at pinned units
    values: np.ndarray  # eigenvalues (M,), the first is 1
    scale: float  # coordinate 1 of the lowest mode in typical displacements


def unit_modes(
    hierarchy: Hierarchy, finest: int, frame: np.ndarray, *, modes: int, solid: SolidSettings, curved: int = 0
) -> UnitModes:
    """The lowest modes at the units of a level, in the axes ``frame`` (3, 3) of the body; see :func:`solid_body`."""
    level, kernels = hierarchy.levels[finest], hierarchy.levels[0]
    rest, pinned = level.rest.double().numpy() @ frame.T, level.pinned.numpy()
    mass = level.volume.double().numpy()
    mass = mass / mass[~pinned].mean()
    own = kernels.rest.double().numpy() @ frame.T
    body = solid_body(
        own, kernels.pinned.numpy(), rest, mass, pinned,
        modes=modes, spacing=solid.size(own, hierarchy.diagonal), inside=solid.held_inside, curved=curved,
    )  # fmt: skip
    phi, slope = body.at(rest)
    phi[pinned], slope[pinned] = 0, 0
    values = np.maximum(body.values, 1e-6 * body.values[-1]) / body.values[0]
    scale = AMPLITUDE * hierarchy.diagonal * math.sqrt(float((~pinned).sum()))
    return UnitModes(body, rest, pinned, mass, phi, slope, values, scale)


class BodyModes(nn.Module):
    """Constants of one scene's geometry in modal coordinates; without trained parameters.

    The law is either of finite strain (``cells``) or of springs between neighbouring units, all of them together as
    stiff as the body in the sum over the modes.
    """

    modes: Tensor  # Phi (N, 3, M), orthonormal under the units' volumes
    gradients: Tensor  # displacement gradients of the modes (N, 3, 3, M) [1 / scene units]
    projection: Tensor  # (N, 3, M), z = sum_n projection_n u_n
    values: Tensor  # eigenvalues of the homogeneous body (M,), the first is 1
    stiffness: Tensor  # K_i of shear and B_i of volume (2, N, M, M); their sum is that of the homogeneous body
    strain: Tensor  # strain of the modes in the cells near each unit, row by row, times volume (N, 9, M)
    inertia: Tensor  # root of M_i, (N, 3, M)
    stretch: Tensor  # root of S_ij, (E, M); (0, M) without springs
    distance: Tensor  # logarithm of the springs' lengths over their mean (E,)
    springs: Springs | None  # with stiffness per unit of S_ij
    cells: FiniteStrain | None  # of the homogeneous body

    def __init__(
        self,
        hierarchy: Hierarchy, finest: int, frame: np.ndarray, *,
        modes: int, solid: SolidSettings, links: int, finite: bool,
    ) -> None:  # fmt: skip
        """Computes the constants in the axes ``frame`` (3, 3) of the body; see :class:`MaterialTemplate`."""
        super().__init__()
        body, rest, pinned, mass, phi, slope, values, self.scale = unit_modes(
            hierarchy, finest, frame, modes=modes, solid=solid, curved=CURVED if finite else 0
        )
        lowest = body.values[0]
        arrays = {
            "modes": phi,
            "gradients": slope,
            "projection": phi * mass[:, None, None],
            "values": values,
            "stiffness": body.cell_stiffness(rest, pinned) / lowest,
            "strain": body.strains(rest),
            "inertia": phi * np.sqrt(mass)[:, None, None],
        }
        springs, arrays["stretch"], arrays["distance"] = None, np.zeros((0, len(values))), np.zeros(0)
        if not finite:
            springs, arrays["stretch"], arrays["distance"] = _net(body, rest, pinned, phi, links)
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)).float(), persistent=False)
        self.springs = springs
        self.cells = FiniteStrain(*body.mean_gradients(rest), scale=1 / lowest) if finite else None


def _net(
    body: SolidBody, rest: np.ndarray, pinned: np.ndarray, phi: np.ndarray, neighbours: int
) -> tuple[Springs, np.ndarray, np.ndarray]:
    """Springs between neighbouring units, the roots (E, M) of S_ij, and logarithms of their lengths over the mean."""
    pairs = _links(rest, pinned, neighbours)
    offset = rest[pairs[1]] - rest[pairs[0]]
    length = np.linalg.norm(offset, axis=1)
    stretch = np.einsum("eam,ea->em", phi[pairs[1]] - phi[pairs[0]], offset) / (length**2)[:, None]
    even = math.sqrt(body.values.sum() / body.values[0] / max(float((stretch**2).sum()), 1e-30))
    return Springs(pairs, rest, phi, (even / length) ** 2), even * stretch, np.log(length / length.mean())


def _links(rest: np.ndarray, pinned: np.ndarray, count: int) -> np.ndarray:
    """Pairs (2, E) of neighbouring units at non-zero distance, at least one of them free."""
    pairs = neighbour_pairs(rest, count)
    distinct = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > 1e-9 * np.abs(rest).max()
    return np.ascontiguousarray(pairs[distinct & ~pinned[pairs].all(1)].T)
