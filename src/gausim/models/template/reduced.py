"""The step of a scene in modal coordinates as plain arrays, for programs without Python such as a web page."""

import numpy as np
import torch

from gausim.models.template.grid import FIRST, SECOND
from gausim.models.template.material import FASTEST, PreparedMaterial

Arrays = dict[str, np.ndarray]


@torch.no_grad()
def reduced_step(part: PreparedMaterial) -> tuple[Arrays, dict[str, float]]:
    """Arrays and numbers of a scene's step.

    Returns:
        ``mass``, ``stiffness``, ``drag`` (M, M) [frame units], the last without what is in proportion to stiffness;
        of the law ``solid`` displacement gradients ``cells`` (N, 9, M) and ``moduli`` (N, 2) of the units' cells
        (2 mu and lambda times volume); of the law ``springs`` ``ends`` (E, 2), ``offset`` (E, 3) and ``spring`` (E,).
        Numbers: ``viscosity`` and ``rate``, by which damping is drag + viscosity K + rate (inertia - mass), ``growth``
        and ``fastest``, as :class:`gausim.models.template.material.Matrices` has them.
    """
    matrices = part.matrices
    slowed = matrices.inertia - matrices.mass
    drag = matrices.damping - matrices.viscosity * matrices.stiffness - matrices.rate * slowed
    arrays = {"mass": matrices.mass, "stiffness": matrices.stiffness, "drag": drag}
    numbers = {
        "viscosity": float(matrices.viscosity),
        "rate": float(matrices.rate),
        "growth": float(matrices.growth),
        "fastest": FASTEST if part.body.cells is not None else 0.0,
    }
    if part.body.cells is not None:
        cells = part.body.cells
        moduli = cells.volume[:, None] * matrices.units * matrices.units.new_tensor((2 * SECOND, FIRST))
        arrays |= {"cells": cells.gradients.unflatten(0, (-1, 9)), "moduli": moduli}
    elif (springs := part.body.springs) is not None:
        arrays |= {"ends": springs.ends.mT, "offset": springs.offset, "spring": matrices.springs * springs.stiffness}
    return {name: array.cpu().numpy() for name, array in arrays.items()}, numbers
