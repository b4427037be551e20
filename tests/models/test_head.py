"""The lever head: gradients that move a unit by a given shift."""

from __future__ import annotations

import torch

from gausim.models.step.head import SHORT, lever_deformation


def test_the_lever_moves_by_the_shift_and_the_volume_is_kept() -> None:
    generator = torch.Generator().manual_seed(0)
    lever = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    shift = 0.1 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    length = torch.full((20, 1), 1e-3, dtype=torch.float64)  # every lever is long
    made = lever_deformation(shift, lever, length, conserve_mass=True)
    moved = (made @ lever[..., None])[..., 0]
    torch.testing.assert_close(moved, lever + shift, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(made), torch.ones(20, dtype=torch.float64), atol=1e-6, rtol=0)
    free = lever_deformation(shift, lever, length, conserve_mass=False)
    torch.testing.assert_close((free @ lever[..., None])[..., 0], moved, atol=1e-6, rtol=0)
    assert float((torch.linalg.det(free) - 1).abs().max()) > 1e-2


def test_no_shift_is_the_identity_and_short_levers_hardly_move() -> None:
    lever = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [SHORT, 0.0, 0.0]], dtype=torch.float64)
    length = torch.ones(3, 1, dtype=torch.float64)
    still = lever_deformation(torch.zeros_like(lever), lever, length, conserve_mass=True)
    torch.testing.assert_close(still, torch.eye(3, dtype=torch.float64).expand(3, 3, 3), atol=1e-12, rtol=0)
    shift = torch.full_like(lever, 0.01)
    made = lever_deformation(shift, lever, length, conserve_mass=True)
    assert torch.isfinite(made).all()
    torch.testing.assert_close(made[1], torch.eye(3, dtype=torch.float64))
    half = (made[2] @ lever[2]) - lever[2]  # at the length SHORT half of the shift is made
    torch.testing.assert_close(half, 0.5 * shift[2], rtol=1e-3, atol=0)
