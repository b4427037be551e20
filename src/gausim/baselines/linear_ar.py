"""Linear AR(p) on principal modes of the true 3D states: reference rows, not methods.

They use data that no method has (the true positions, also of the first p frames), but no physics, images or network:
linear elasticity in few modes, fitted by least squares. A method that predicts worse than this has learned little. Two
frames are the state of an elastic body of which the modes show everything; four remember what they do not show.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DataError

# Ridges among which one is chosen on the seen frames [mean squares of the coordinates].
RIDGES = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
# Largest growth per frame of a chosen fit, twofold in 35 frames: bodies without a drive do not grow.
MOST_GROWTH = 1.02


@dataclass(frozen=True, eq=False)
class LinearAR:
    """q_t = sum_k A_k q_{t-k} with q the coordinates of the displacement in M orthonormal modes."""

    modes: Float[Tensor, "M P 3"]  # orthonormal modes of the displacement of P points
    coefficients: Float[Tensor, "p M M"]  # A_1, ..., A_p

    @property
    def order(self) -> int:
        """The number p of frames from which a rollout starts."""
        return len(self.coefficients)

    @property
    def growth(self) -> float:
        """Largest factor per frame by which a motion grows: the spectral radius of the companion matrix."""
        order, size, _ = self.coefficients.shape
        kept = torch.eye(size * (order - 1), size * order).to(self.coefficients)
        companion = torch.cat((self.coefficients.transpose(0, 1).flatten(1), kept))
        return float(torch.linalg.eigvals(companion).abs().max())

    def rollout(self, displacement: Float[Tensor, "p P 3"], steps: int) -> Float[Tensor, "F P 3"]:
        """Predicts ``steps`` frames after frame 0 from the displacements in the first p frames, which come first."""
        modes = self.modes.flatten(1)
        q = continued(self.coefficients, displacement.to(modes).flatten(1) @ modes.T, steps + 1)
        return (q @ modes).reshape(-1, *displacement.shape[1:]).to(displacement)


def continued(coefficients: Float[Tensor, "p M M"], begun: Float[Tensor, "p M"], frames: int) -> Float[Tensor, "F M"]:
    """Coordinates of so many frames, of which the first p are given."""
    q = list(begun)
    while len(q) < frames:
        q.append(sum((a @ q[-k] for k, a in enumerate(coefficients, 1)), torch.zeros_like(q[0])))
    return torch.stack(q[:frames])


def fit_linear_ar(
    displacements: Sequence[Float[Tensor, "F P 3"]], n_modes: int, order: int = 2, *, ridge: float = 0.0
) -> LinearAR:
    """Fits at most ``n_modes`` modes and coefficients to the seen frames of all sequences, in float64.

    The modes are those of the displacements from rest [scene units] themselves, not of their deviation from a mean:
    the rest state is the equilibrium. Where the motion has fewer modes than requested, the others are 0 (least-norm
    solution). ``ridge`` is the weight of the squared coefficients, in mean squares of the coordinates times the number
    of transitions.

    Raises:
        DataError: there is no sequence, or one has not more than ``order`` frames.
    """
    return _fit(_coordinates(displacements, order), n_modes, order, ridge)


def choose_linear_ar(displacements: Sequence[Float[Tensor, "F P 3"]], sizes: Sequence[int], order: int) -> LinearAR:
    """Of several numbers of modes and :data:`RIDGES` those that predict a sequence best that was left out.

    Of a single sequence the first two thirds of its frames predict all. A fit that grows is chosen only if all do.

    Raises:
        DataError: as :func:`fit_linear_ar`.
    """
    settings = list(itertools.product(sizes, RIDGES))
    errors = np.zeros(len(settings))
    for number, own in enumerate(displacements):
        part = own[: max(order + 1, 2 * len(own) // 3)]
        known = _coordinates([*displacements[:number], *displacements[number + 1 :]] or [part], order)
        for i, (n_modes, ridge) in enumerate(settings):
            made = _fit(known, n_modes, order, ridge).rollout(own[:order], len(own) - 1)
            errors[i] += float((made - own).square().mean())
    known = _coordinates(displacements, order)
    fits = [_fit(known, n_modes, order, ridge) for n_modes, ridge in settings]
    return min(zip(fits, errors, strict=True), key=lambda own: (own[0].growth > MOST_GROWTH, own[1]))[0]


def _coordinates(displacements: Sequence[Tensor], order: int) -> tuple[Tensor, list[Tensor]]:
    """All modes (M, P, 3), the largest first, and coordinates (F, M) of every sequence."""
    if not displacements or any(len(d) <= order for d in displacements):
        raise DataError(
            f"linear AR({order}): expected at least one sequence, with at least {order + 1} seen frames in each."
        )
    rows = [d.double().flatten(1) for d in displacements]
    _, _, modes = torch.linalg.svd(torch.cat(rows), full_matrices=False)
    return modes.reshape(-1, *displacements[0].shape[1:]), [row @ modes.T for row in rows]


def _fit(known: tuple[Tensor, list[Tensor]], n_modes: int, order: int, ridge: float) -> LinearAR:
    modes, coordinates = known
    return LinearAR(modes[:n_modes], _fitted([q[:, :n_modes] for q in coordinates], order, ridge))


def _fitted(coordinates: Sequence[Tensor], order: int, ridge: float) -> Float[Tensor, "p M M"]:
    known = torch.cat([torch.cat([q[order - k : len(q) - k] for k in range(1, order + 1)], 1) for q in coordinates])
    following = torch.cat([q[order:] for q in coordinates])
    if ridge:
        weight = (ridge * known.square().mean() * len(known)).sqrt()
        known = torch.cat((known, weight * torch.eye(known.shape[1]).to(known)))
        following = torch.cat((following, following.new_zeros(known.shape[1], following.shape[1])))
    # gelsd gives the least-norm solution also where modes are empty or transitions are few.
    solution = torch.linalg.lstsq(known, following, driver="gelsd").solution.T
    return torch.stack(solution.chunk(order, 1))
