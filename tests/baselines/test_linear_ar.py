import pytest
import torch

from gausim.baselines.linear_ar import RIDGES, choose_linear_ar, fit_linear_ar
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
    linear = fit_linear_ar([s[:16] for s in sequences], n_modes)
    for truth in sequences:
        predicted = linear.rollout(truth[:2], 59)
        assert predicted.shape == truth.shape
        assert torch.allclose(predicted, truth, atol=1e-8)


def test_four_frames_remember_what_two_do_not_and_few_are_refused() -> None:
    """Points that show only the sum of two oscillations: not AR(2), but exactly AR(4)."""
    sequences = []
    for seed in range(4):
        draws = torch.Generator().manual_seed(seed)
        wave = torch.zeros(40, dtype=torch.float64)
        for omega in (0.5, 1.3):
            a, b = (torch.rand(2, generator=draws, dtype=torch.float64) - 0.5).tolist()
            t = omega * torch.arange(40, dtype=torch.float64)
            wave += a * torch.cos(t) + b * torch.sin(t)
        sequences.append(wave[:, None, None] * torch.tensor([[1.0, 0.0, 0.5], [0.2, 1.0, 0.0]], dtype=torch.float64))
    seen = [s[:16] for s in sequences]
    two, four = fit_linear_ar(seen, 1, 2), choose_linear_ar(seen, (1, 2), 4)
    assert (two.order, four.order) == (2, 4)
    for truth in sequences:
        assert torch.allclose(four.rollout(truth[:4], 39), truth, atol=1e-6)
        assert not torch.allclose(two.rollout(truth[:2], 39), truth, atol=0.05)
    with pytest.raises(DataError, match="at least 3 seen frames"):
        fit_linear_ar([torch.zeros(2, 4, 3)], 2)


def test_the_ridge_is_chosen_where_noise_needs_one():
    noise = [0.02 * torch.randn(16, 5, 3, generator=torch.Generator().manual_seed(s)).double() for s in range(4)]
    noisy = [oscillations(16, seed) + noise[seed] for seed in range(4)]
    chosen, plain = choose_linear_ar(noisy, (6,), 4), fit_linear_ar(noisy, 6, 4)
    fits = [fit_linear_ar(noisy, 6, 4, ridge=ridge).coefficients for ridge in RIDGES]
    assert any(torch.equal(chosen.coefficients, own) for own in fits)
    assert float(chosen.coefficients.norm()) < float(plain.coefficients.norm())
    alone = choose_linear_ar([oscillations(16, 0)], (2,), 4)
    assert torch.allclose(alone.rollout(oscillations(60, 0)[:4], 59), oscillations(60, 0), atol=1e-6)
