"""Springs between units: their forces beyond the linear part."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gausim.kernels.operations import LEAST_SQUARE, operation


def neighbour_pairs(rest: np.ndarray, neighbours: int) -> np.ndarray:
    """Distinct pairs (E, 2) of points (N, 3), of which one is among the other's nearest neighbours."""
    k = min(neighbours + 1, len(rest))
    near = cKDTree(rest).query(rest, k=k)[1].reshape(len(rest), k)[:, 1:]
    pairs = np.stack((np.repeat(np.arange(len(rest)), k - 1), near.ravel()), 1)
    pairs = np.unique(np.sort(pairs, 1), axis=0)
    return pairs[pairs[:, 0] != pairs[:, 1]]


@dataclass(frozen=True, eq=False)
class Stretched:
    """Springs in a state."""

    change: Float[Tensor, "S E 3"]  # d - d_0 [scene units]
    offset: Float[Tensor, "E 3"]  # d_0 [scene units]
    rest: Float[Tensor, " E"]  # |d_0| [scene units]

    @cached_property
    def along(self) -> Float[Tensor, "S E"]:
        """d_0 . (d - d_0)."""
        return (self.offset * self.change).sum(-1)

    @cached_property
    def grown(self) -> Float[Tensor, "S E"]:
        """|d|^2 - |d_0|^2."""
        return 2 * self.along + self.change.square().sum(-1)

    @cached_property
    def length(self) -> Float[Tensor, "S E"]:
        """|d|."""
        squared = self.rest.square()
        return (squared + self.grown).clamp_min(LEAST_SQUARE * squared).sqrt()

    @cached_property
    def stretch(self) -> Float[Tensor, "S E"]:
        """|d| - |d_0|, without the cancellation of a difference."""
        return self.grown / (self.length + self.rest)


@operation("gausim.kernels.elastic:spring_pull")
def spring_pull(
    first: Float[Tensor, "S E 3"],
    second: Float[Tensor, "S E 3"],
    offset: Float[Tensor, "E 3"],
    length: Float[Tensor, " E"],
    stiffness: Float[Tensor, " E"],
    damping: Tensor | float,
) -> Float[Tensor, "S E 3"]:
    """Mean pull of every spring from one state to another, beyond the linear one; see :meth:`Springs.between`."""
    before, after = (Stretched(change, offset, length) for change in (first, second))
    shrink = 2 * _tension(before, after, damping) / (before.length + after.length)
    linear = (before.along + after.along) / 2 / length.square()
    pull = shrink[..., None] * (first + second) / 2 + (shrink - linear)[..., None] * offset
    return stiffness[:, None] * pull


class Springs(nn.Module):
    """Nonlinear forces of springs between units under large rotations and stretches, in modal coordinates.

    A spring from d_0 to d = d_0 + Psi z has the energy k (|d| - |d_0|)^2 / 2, linearised k (n . Psi z)^2 / 2 with
    n = d_0 / |d_0|. The force is minus the derivative of their difference, so it has a potential and is of second order
    in z; the linear part is in the trained matrices. Where the reference of the modes is itself strained, by S, a
    spring is already changed by S d_0: d = d_0 + S d_0 + Psi z, so that a taut body is stiffer to bending.
    """

    modes: Tensor  # Psi, differences of the modes between the ends, (3 E, M)
    offset: Tensor  # d_0 (E, 3) [scene units]
    length: Tensor  # |d_0| (E,) [scene units]
    stiffness: Tensor  # k (E,), up to the argument ``factor``
    ends: Tensor  # the units between which each is (2, E)

    def __init__(self, ends: np.ndarray, rest: np.ndarray, phi: np.ndarray, stiffness: np.ndarray) -> None:
        """Springs of ``stiffness`` (E,) between pairs (2, E) of units at ``rest`` (N, 3) with modes (N, 3, M)."""
        super().__init__()
        offset = rest[ends[1]] - rest[ends[0]]
        arrays = {
            "modes": (phi[ends[1]] - phi[ends[0]]).reshape(-1, phi.shape[-1]),
            "offset": offset,
            "length": np.sqrt((offset**2).sum(1)),
            "stiffness": stiffness,
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(array).float(), persistent=False)
        self.register_buffer("ends", torch.from_numpy(np.ascontiguousarray(ends)), persistent=False)

    def reference_strain(self, strain: Float[Tensor, "S N 9"]) -> Float[Tensor, "S E 3"]:
        """S d_0 of every spring, S the mean of both ends."""
        both = strain.index_select(1, self.ends.flatten()).unflatten(1, (2, -1)).mean(1)
        return (both.unflatten(-1, (3, 3)) @ self.offset[..., None])[..., 0]

    def pull(self, strain: Float[Tensor, "S N 9"], factor: Tensor | float = 1.0) -> Float[Tensor, "S M"]:
        """Linear part of the modal forces of a strained reference."""
        along = (self.reference_strain(strain) * self.offset).sum(-1) / self.length.square()
        return -((factor * self.stiffness * along)[..., None] * self.offset).flatten(-2) @ self.modes

    def strain_state(self, z: Float[Tensor, "S M"], reference: Float[Tensor, "S E 3"] | None = None) -> Stretched:
        """Every spring in a state of the modes; ``reference`` is that of :meth:`reference_strain`."""
        change = (z @ self.modes.mT).unflatten(-1, (-1, 3))
        change = change if reference is None else change + reference
        return Stretched(change, self.offset, self.length)

    def stiffening(
        self, first: Stretched, second: Stretched, factor: Tensor | float = 1.0, damping: Tensor | float = 0.0,
        *, buckling: bool = False,
    ) -> Float[Tensor, "S M M"]:  # fmt: skip
        """Twice the negative derivative of :meth:`between` with respect to z of the second state.

        With d and l the means of both springs and of both lengths, n_0 and n the directions at rest and in the second
        state, and t = (tension over stiffness) / l, a spring contributes k times

            ((1 + 2 damping) / l - t / l) d n^T + t I - n_0 n_0^T

        For one and the same state without damping this is the change of the stiffness from rest to it. Compressed
        springs (t < 0) buckle; for them t I is left out, so that this matrix is positive semi-definite then. With
        ``buckling`` it is not, and the derivative is exact.
        """
        k, length = factor * self.stiffness, (first.length + second.length) / 2
        middle = (first.change + second.change) / 2 + self.offset
        t = _tension(first, second, damping) / length
        grown = (k * (1 + 2 * damping - t) / length)[..., None] * middle
        towards = self._along((second.change + self.offset) / second.length[..., None])
        rest = self._along(self.offset / self.length[:, None])
        turned = grown[..., None] * towards[..., None, :]
        turned = turned.addcmul_(
            (k * (t if buckling else t.clamp_min(0)))[..., None, None], self.modes.unflatten(0, (-1, 3))
        )
        return self.modes.mT @ turned.flatten(-3, -2) - rest.mT @ (k[:, None] * rest)

    def _along(self, direction: Float[Tensor, "*S E 3"]) -> Float[Tensor, "*S E M"]:
        """Products of a direction per spring with its modes."""
        x, y, z = (d[..., None] for d in direction.unbind(-1))
        modes = self.modes.unflatten(0, (-1, 3)).unbind(1)
        return torch.addcmul(torch.addcmul(x * modes[0], y, modes[1]), z, modes[2])

    def between(
        self, first: Stretched, second: Stretched, factor: Tensor | float = 1.0, damping: Tensor | float = 0.0
    ) -> Float[Tensor, "S M"]:
        """Mean nonlinear force from one state to another, whose work is the loss of :meth:`potential` and damping.

        A spring pulls along the mean of both d as one of the mean of both lengths does (Simo and Tarnow 1992), and more
        by ``damping`` times the growth of its length (Armero and Romero 2001), which no rotation changes.
        ``factor`` is on the stiffness, one number or one per spring (E,).
        """
        k = factor * self.stiffness
        pull = spring_pull(first.change, second.change, self.offset, self.length, k, damping)
        return -(pull.flatten(-2) @ self.modes)

    def dissipated(
        self, first: Stretched, second: Stretched, factor: Tensor | float, damping: Tensor | float
    ) -> Float[Tensor, " S"]:
        """Energy that ``damping`` takes from one state to another."""
        return damping * (factor * self.stiffness * (second.stretch - first.stretch).square()).sum(-1)

    def potential(self, state: Stretched, factor: Tensor | float = 1.0) -> Float[Tensor, " S"]:
        """Potential energy of the nonlinear force."""
        linear = state.along.square() / self.length.square()
        return 0.5 * (factor * self.stiffness * (state.stretch.square() - linear)).sum(-1)


def _tension(first: Stretched, second: Stretched, damping: Tensor | float) -> Tensor:
    return (first.stretch + second.stretch) / 2 + damping * (second.stretch - first.stretch)
