"""Stress of the material on single gradients, against the closed formula of principal stretches."""

from __future__ import annotations

import numpy as np
import pytest

wp = pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm.device_code.elasticity import fixed_corotated  # noqa: E402

MU, LAM = 2.0, 3.0


@wp.kernel
def answer(F: wp.array[wp.mat33], stress: wp.array[wp.mat33]):
    i = wp.tid()
    stress[i] = fixed_corotated(F[i], 2.0, 3.0)


def deformation_gradients(count: int, size: float, seed: int) -> np.ndarray:
    return np.eye(3) + size * np.random.default_rng(seed).standard_normal((count, 3, 3))


def on_device(F: np.ndarray) -> np.ndarray:
    stress = wp.zeros(len(F), dtype=wp.mat33, device="cpu")
    wp.launch(answer, len(F), inputs=[wp.array(F, dtype=wp.mat33, device="cpu")], outputs=[stress], device="cpu")
    return stress.numpy()


def expected(F: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(F)
    J = np.linalg.det(F)[:, None, None]
    return 2 * MU * (F - u @ vt) @ F.swapaxes(1, 2) + LAM * J * (J - 1) * np.eye(3)


@pytest.mark.parametrize("size", [0.15, 1e-3])
def test_stress_follows_the_closed_formula(size: float):
    F = deformation_gradients(200, size, 1)
    assert np.abs(on_device(F) - expected(F)).max() < 1e-4 * size + 4e-6


def test_stress_at_rest_is_zero_and_turning_leaves_it_zero():
    turn = np.linalg.qr(deformation_gradients(50, 1.0, 3))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    assert np.abs(on_device(turn)).max() < 5e-6
    assert np.abs(on_device(np.eye(3)[None])).max() == 0


@pytest.mark.parametrize("size", [0.15, 0.0])
def test_derivatives_agree_with_differences_also_at_rest(size: float):
    F, weight = deformation_gradients(60, size, 5), deformation_gradients(60, 1.0, 6)
    found = wp.zeros(len(F), dtype=wp.mat33, device="cpu")
    wp.launch(
        answer,
        len(F),
        inputs=[wp.array(F, dtype=wp.mat33, device="cpu")],
        outputs=[wp.zeros(len(F), dtype=wp.mat33, device="cpu")],
        adj_inputs=[found],
        adj_outputs=[wp.array(weight, dtype=wp.mat33, device="cpu")],
        adjoint=True,
        device="cpu",
    )
    true = np.zeros_like(F)
    for a in range(3):
        for b in range(3):
            step = np.zeros((3, 3))
            step[a, b] = 1e-6
            true[:, a, b] = ((expected(F + step) - expected(F - step)) * weight).sum((1, 2)) / 2e-6
    assert np.abs(found.numpy() - true).max() < 2e-3 * np.abs(true).max()
