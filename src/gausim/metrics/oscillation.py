"""Principal motions of displacements, the few orthogonal shapes with the largest square, and their spectrum."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import periodogram

Array = NDArray[np.float64]


def principal_motions(displacements: Sequence[NDArray], count: int) -> tuple[Array, Array]:
    """The ``count`` first principal components of displacements (F, P, 3) from rest, over all sequences.

    Returns (M, 3 P) orthonormal shapes, and the fraction (M,) of the squared displacement in each, the largest
    first.
    """
    rows = np.concatenate([d.reshape(len(d), -1) for d in displacements]).astype(np.float64)
    values, vectors = np.linalg.eigh(rows @ rows.T)  # far fewer frames than coordinates
    total = max(float(values.sum()), np.finfo(float).tiny)
    chosen = [i for i in np.argsort(values)[::-1][:count] if values[i] > 1e-12 * total]
    shapes = (vectors[:, chosen] / np.sqrt(values[chosen])).T @ rows
    return shapes, values[chosen] / total


def coordinates(displacement: NDArray, shapes: Array) -> Array:
    """(F, M) coordinates of a sequence's displacements (F, P, 3) in the shapes."""
    return displacement.reshape(len(displacement), -1) @ shapes.T


def spectrum(series: Sequence[Array], fps: float) -> tuple[Array, Array]:
    """Frequencies (B,) [Hz] and the power (B,) of coordinates (F, M), summed over them, mean over sequences.

    Sequences are cut to the shortest, centred and multiplied by a Hann window.
    """
    length = min(len(s) for s in series)
    found = [periodogram(s[:length], fs=fps, window="hann", detrend="constant", axis=0) for s in series]
    return found[0][0], np.mean([power.sum(1) for _, power in found], axis=0)
