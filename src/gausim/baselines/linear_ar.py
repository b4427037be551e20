"""Linear AR(2) on principal modes of the true 3D states: a reference row, not a method.

It uses data that no method has (the true positions, also of the first two frames), but no physics, images or network:
linear elasticity in few modes, fitted by least squares. A method that predicts worse than this has learned little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DataError


@dataclass(frozen=True, eq=False)
class LinearAR2:
    """q_{t+1} = A q_t + B q_{t-1} with q the coordinates of the displacement in M orthonormal modes."""

    modes: Float[Tensor, "M P 3"]  # orthonormal modes of the displacement of P points
    first: Float[Tensor, "M M"]  # A
    second: Float[Tensor, "M M"]  # B

    def rollout(self, displacement: Float[Tensor, "2 P 3"], steps: int) -> Float[Tensor, "F P 3"]:
        """Predicts ``steps`` frames after frame 0 from the displacements in frames 0 and 1, which come first."""
        modes = self.modes.flatten(1)
        q = [x for x in displacement.to(modes).flatten(1) @ modes.T]
        for _ in range(steps - 1):
            q.append(self.first @ q[-1] + self.second @ q[-2])
        predicted = torch.stack(q[: steps + 1]) @ modes
        return predicted.reshape(-1, *displacement.shape[1:]).to(displacement)


def fit_linear_ar2(displacements: Sequence[Float[Tensor, "F P 3"]], n_modes: int) -> LinearAR2:
    """Fits at most ``n_modes`` modes and coefficients to the seen frames of all sequences by least squares, in float64.

    The modes are those of the displacements from rest [scene units] themselves, not of their deviation from a mean:
    the rest state is the equilibrium. Where the motion has fewer modes than requested, the others are 0 (least-norm
    solution).

    Raises:
        DataError: there is no sequence, or one has fewer than three frames.
    """
    if not displacements or any(len(d) < 3 for d in displacements):
        raise DataError("linear AR(2): expected at least one sequence with at least three seen frames in each.")
    rows = [d.double().flatten(1) for d in displacements]
    _, _, modes = torch.linalg.svd(torch.cat(rows), full_matrices=False)
    modes = modes[:n_modes]
    coordinates = [r @ modes.T for r in rows]
    now_and_before = torch.cat([torch.cat((q[1:-1], q[:-2]), 1) for q in coordinates])
    following = torch.cat([q[2:] for q in coordinates])
    # gelsd gives the least-norm solution also where modes are empty or transitions are few.
    solution = torch.linalg.lstsq(now_and_before, following, driver="gelsd").solution.T
    m = len(modes)
    return LinearAR2(modes.reshape(m, *displacements[0].shape[1:]), solution[:, :m], solution[:, m:])
