from __future__ import annotations

import pytest
import torch

from gausim.baselines.linear_ar import fit_linear_ar2
from gausim.core import DataError


def oscillations(frames: int, seed: int) -> torch.Tensor:
    """Two damped modes of five points with their own frequencies: exactly linear AR(2)."""
    shapes = torch.linalg.qr(torch.randn(15, 2, generator=torch.Generator().manual_seed(7), dtype=torch.float64))[0].T
    generator = torch.Generator().manual_seed(seed)
    amplitude = torch.rand(2, 2, generator=generator, dtype=torch.float64) - 0.5
    t = torch.arange(frames, dtype=torch.float64)
    total = torch.zeros(frames, 15, dtype=torch.float64)
    for mode, (omega, damping) in enumerate([(0.5, 0.99), (1.1, 0.97)]):
        wave = amplitude[mode, 0] * torch.cos(omega * t) + amplitude[mode, 1] * torch.sin(omega * t)
        total += (damping**t * wave)[:, None] * shapes[mode]
    return total.reshape(frames, 5, 3)


@pytest.mark.parametrize("n_modes", [2, 6])
def test_recovers_an_exact_linear_oscillation(n_modes: int):
    sequences = [oscillations(60, seed) for seed in range(4)]
    linear = fit_linear_ar2([s[:16] for s in sequences], n_modes)
    for truth in sequences:
        predicted = linear.rollout(truth[:2], 59)
        assert predicted.shape == truth.shape
        assert torch.allclose(predicted, truth, atol=1e-8)


def test_short_sequences_are_refused():
    with pytest.raises(DataError, match="three seen frames"):
        fit_linear_ar2([torch.zeros(2, 4, 3)], 2)
