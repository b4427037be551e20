"""The step of a scene in modal coordinates as plain arrays, for programs without Python such as a web page.

The energy of finite strain (:mod:`gausim.models.template.finite_strain`) is a polynomial of degree four in z (Barbic
and James 2005). With the strain E(z) = sum_i e_i z_i + sum_ij e_ij z_i z_j / 2 of all units, e_i = sym H_i and
e_ij = sym(H_i^T H_j), and y = (z_i ..., z_i z_j (i > j), z_i^2 / 2 ...), it is y^T G y / 2 with the constant matrix
G of the products of all e under Hooke's law. A step then takes the same time for any number of units.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.grid import FIRST, SECOND
from gausim.models.template.material import FASTEST, PreparedMaterial

Arrays = dict[str, np.ndarray]
# Units whose strains are in memory at once.
CHUNK = 128


@torch.no_grad()
def reduced_step(part: PreparedMaterial) -> tuple[Arrays, dict[str, float]]:
    """Arrays and numbers of a scene's step.

    Returns:
        ``mass``, ``stiffness``, ``drag`` (M, M) [frame units], the last without what is in proportion to stiffness;
        of the law ``solid`` the blocks of G, ``linear`` (M, M), ``mixed`` (M, P) and ``quadratic`` (P (P + 1) / 2,),
        lower triangles row by row, displacement gradients ``cells`` (N, 9, M) and ``moduli`` (N, 2) of the units' cells
        (2 mu and lambda times volume); of the law ``springs`` ``ends`` (E, 2), ``offset`` (E, 3) and ``spring`` (E,).
        Numbers: ``viscosity`` and ``rate``, by which damping is drag + viscosity K + rate (inertia - mass), ``growth``
        and ``fastest``, as :class:`gausim.models.template.material.Matrices` has them.
    """
    found = part.matrices
    slowed = found.inertia - found.mass
    drag = found.damping - found.viscosity * found.stiffness - found.rate * slowed
    arrays = {"mass": found.mass, "stiffness": found.stiffness, "drag": drag}
    numbers = {
        "viscosity": float(found.viscosity),
        "rate": float(found.rate),
        "growth": float(found.growth),
        "fastest": FASTEST if part.body.cells is not None else 0.0,
    }
    if part.body.cells is not None:
        cells = part.body.cells
        moduli = cells.volume[:, None] * found.units * found.units.new_tensor((2 * SECOND, FIRST))
        arrays |= _products(cells, found.units) | {
            "cells": cells.gradients.unflatten(0, (-1, 9)), "moduli": moduli,
        }  # fmt: skip
    else:
        springs = part.body.springs
        arrays |= {"ends": springs.ends.mT, "offset": springs.offset, "spring": found.springs * springs.stiffness}
    return {name: array.cpu().numpy() for name, array in arrays.items()}, numbers


def _products(cells: FiniteStrain, factor: Tensor) -> dict[str, Tensor]:
    """The blocks of G."""
    gradients = cells.gradients.double().unflatten(0, (-1, 9))
    count, modes = len(gradients), gradients.shape[-1]
    weights = (cells.volume[:, None] * factor).double() @ cells.moduli.double()  # (N, 7)
    measures = cells.measures.double().view(9, 7, 9)
    rows, columns = torch.tril_indices(modes, modes)
    one = torch.eye(3, dtype=torch.float64).flatten()
    whole = torch.zeros(modes + len(rows), modes + len(rows), dtype=torch.float64)
    for begin in range(0, count, CHUNK):
        h = gradients[begin : begin + CHUNK]
        first = torch.einsum("a,amb,nbi->nmi", one, measures, h)
        half = torch.einsum("nai,amb->nimb", h, measures)
        second = torch.einsum("nimb,nbj->nmij", half, h)[..., rows, columns]
        strains = (torch.cat((first, second), -1) * weights[begin : begin + CHUNK, :, None].sqrt()).flatten(0, 1)
        whole += strains.mT @ strains
    low = torch.tril_indices(len(rows), len(rows))
    quadratic = whole[modes:, modes:]
    return {
        "linear": whole[:modes, :modes].float(),
        "mixed": whole[:modes, modes:].float(),
        "quadratic": quadratic[low[0], low[1]].float(),
    }
