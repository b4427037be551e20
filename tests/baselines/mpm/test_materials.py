"""Stress and return map of every material on single gradients, against closed formulas of principal stretches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

wp = pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm.config import Material, MaterialKind  # noqa: E402
from gausim.baselines.mpm.device_code.constitutive import kirchhoff_stress, return_map, softened  # noqa: E402

MU, LAM, YIELD, DT = 2.0, 3.0, 1.4, 0.05
MATERIAL = Material(plastic_viscosity=0.4, softening=0.7)
RHEOLOGY = wp.vec3(MATERIAL.friction, MATERIAL.plastic_viscosity, MATERIAL.softening)
KINDS = list(MaterialKind)


@wp.kernel
def answer(
    kind: int,
    F: wp.array[wp.mat33],
    y: wp.array[float],
    rheology: wp.vec3,
    mapped: wp.array[wp.mat33],
    stress: wp.array[wp.mat33],
    left: wp.array[float],
):
    i = wp.tid()
    mapped[i] = return_map(kind, F[i], 2.0, 3.0, y[i], rheology, 0.05)
    stress[i] = kirchhoff_stress(kind, F[i], 2.0, 3.0, y[i])
    left[i] = softened(kind, F[i], 2.0, y[i], rheology)


def deformation_gradients(count: int, size: float, seed: int) -> np.ndarray:
    return np.eye(3) + size * np.random.default_rng(seed).standard_normal((count, 3, 3))


def on_device(kind: int, F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(F)
    outputs = [wp.zeros(n, dtype=wp.mat33, device="cpu") for _ in range(2)] + [wp.zeros(n, device="cpu", dtype=float)]
    inputs = [kind, wp.array(F, dtype=wp.mat33, device="cpu"), wp.full(n, YIELD, device="cpu", dtype=float), RHEOLOGY]
    wp.launch(answer, n, inputs=inputs, outputs=outputs, device="cpu")
    return tuple(o.numpy() for o in outputs)


def principal(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    u, s, vt = np.linalg.svd(F)
    return u, np.log(s), vt


def expected_strain(kind: MaterialKind, strain: np.ndarray) -> np.ndarray:
    """Log stretches after the return map."""
    mean = strain.mean(-1, keepdims=True)
    shear = strain - mean
    size = np.linalg.norm(shear, axis=-1, keepdims=True)
    if kind in (MaterialKind.VON_MISES, MaterialKind.PLASTICINE):
        return mean + shear * np.minimum(1, YIELD / (2 * MU) / size)
    if kind is MaterialKind.DRUCKER_PRAGER:
        flow = size + MATERIAL.friction * (3 * LAM + 2 * MU) / (2 * MU) * 3 * mean
        grains = np.where(flow > 0, mean + shear * (1 - flow / size), strain)
        return np.where(mean >= 0, 0.0, grains)
    if kind is MaterialKind.VISCOPLASTIC:
        over = 2 * MU * size - np.sqrt(2 / 3) * YIELD
        mu_hat = MU * np.exp(2 * strain).sum(-1, keepdims=True) / 3
        kept = 1 - over / (1 + MATERIAL.plastic_viscosity / (2 * mu_hat * DT)) / (2 * MU * size)
        return np.where(over > 0, mean + shear * kept, strain)
    return strain


def expected(kind: MaterialKind, F: np.ndarray) -> np.ndarray:
    u, strain, vt = principal(F)
    return (u * np.exp(expected_strain(kind, strain))[..., None, :]) @ vt


def expected_stress(kind: MaterialKind, F: np.ndarray) -> np.ndarray:
    u, strain, vt = principal(F)
    if kind in (MaterialKind.FIXED_COROTATED, MaterialKind.PLASTICINE):
        J = np.linalg.det(F)[:, None, None]
        return 2 * MU * (F - u @ vt) @ F.swapaxes(1, 2) + LAM * J * (J - 1) * np.eye(3)
    tau = 2 * MU * strain + LAM * strain.sum(-1, keepdims=True)
    return (u * tau[..., None, :]) @ u.swapaxes(1, 2)


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name.lower())
@pytest.mark.parametrize("size", [0.15, 1e-3])
def test_stress_and_return_map_follow_the_closed_formulas(kind: MaterialKind, size: float):
    F = deformation_gradients(200, size, 1)
    mapped, stress, left = on_device(kind, F)
    strain = principal(F)[1]
    plastic = np.abs(expected_strain(kind, strain) - strain).max(-1) > 1e-6
    if size > 0.1 and kind is not MaterialKind.FIXED_COROTATED:
        assert 10 < plastic.sum() < 200  # both branches are seen
    error = np.abs(mapped - expected(kind, F)).max(), np.abs(stress - expected_stress(kind, F)).max()
    print(kind.name, size, "F {:.1e} tau {:.1e}".format(*error))
    assert np.abs(mapped - expected(kind, F)).max() < 1e-4 * size + 1e-6
    assert np.abs(stress - expected_stress(kind, F)).max() < 1e-4 * size + 4e-6
    flow = np.linalg.norm(strain - expected_strain(kind, strain), axis=-1)
    softening = MATERIAL.softening if kind is MaterialKind.PLASTICINE else 0.0
    assert np.allclose(left, YIELD - softening * flow, atol=1e-5)


def test_von_mises_ends_on_its_surface_and_sand_on_its_cone():
    F = deformation_gradients(200, 0.15, 2)
    mapped = on_device(MaterialKind.VON_MISES, F)[0]
    strain = principal(mapped.astype(np.float64))[1]
    shear = 2 * MU * np.linalg.norm(strain - strain.mean(-1, keepdims=True), axis=-1)
    assert shear.max() < YIELD * (1 + 1e-4) and (shear > YIELD * (1 - 1e-4)).sum() > 20
    F = np.array([0.95 * np.diag([1.4, 1.0, 0.6]), 1.1 * np.eye(3)])  # sheared under pressure; pulled apart
    mapped = on_device(MaterialKind.DRUCKER_PRAGER, F)[0].astype(np.float64)
    strain = principal(mapped)[1]
    shear = np.linalg.norm(strain[0] - strain[0].mean())
    pressure = -strain[0].sum() * (3 * LAM + 2 * MU) / (2 * MU)
    sine = np.sin(np.radians(25))
    assert shear == pytest.approx(np.sqrt(2 / 3) * 2 * sine / (3 - sine) * pressure, rel=1e-4)
    assert np.abs(strain[1]).max() < 1e-6


def test_stress_at_rest_is_zero_and_turning_leaves_it_zero():
    turn = np.linalg.qr(deformation_gradients(50, 1.0, 3))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    for kind in KINDS:
        assert np.abs(on_device(kind, turn)[1]).max() < 5e-6
        assert np.abs(on_device(kind, np.eye(3)[None])[1]).max() == 0


def test_plasticine_without_yield_stress_left_bears_nothing():
    F = deformation_gradients(3, 0.1, 4)
    inputs = [int(MaterialKind.PLASTICINE), wp.array(F, dtype=wp.mat33, device="cpu")]
    outputs = [wp.zeros(3, dtype=wp.mat33, device="cpu") for _ in range(2)] + [wp.zeros(3, dtype=float, device="cpu")]
    soft = wp.full(3, -0.1, dtype=float, device="cpu")
    wp.launch(answer, 3, inputs=[*inputs, soft, RHEOLOGY], outputs=outputs, device="cpu")
    assert not outputs[1].numpy().any() and np.allclose(outputs[0].numpy(), F, atol=1e-6)


def slope(function: Callable[[np.ndarray], np.ndarray], F: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Central differences of sum weight . function(F) in float64."""
    found = np.zeros_like(F)
    for a in range(3):
        for b in range(3):
            step = np.zeros((3, 3))
            step[a, b] = 1e-6
            found[:, a, b] = ((function(F + step) - function(F - step)) * weight).sum((1, 2)) / 2e-6
    return found


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name.lower())
@pytest.mark.parametrize("size", [0.15, 0.0])
def test_derivatives_agree_with_differences_also_at_rest(kind: MaterialKind, size: float):
    F, weight = deformation_gradients(60, size, 5), deformation_gradients(60, 1.0, 6)
    if size == 0:  # at rest the maps of plasticity have an edge or a singular direction; the stress has not
        maps = [("stress", expected_stress)]
    else:
        maps = [("map", expected), ("stress", expected_stress)]
    for name, function in maps:
        n = len(F)
        arrays = [wp.array(F, dtype=wp.mat33, device="cpu"), wp.full(n, YIELD, dtype=float, device="cpu")]
        outputs = [wp.zeros(n, dtype=wp.mat33, device="cpu") for _ in range(2)]
        outputs.append(wp.zeros(n, dtype=float, device="cpu"))
        given = [wp.zeros_like(o) for o in outputs]
        given[0 if name == "map" else 1] = wp.array(weight, dtype=wp.mat33, device="cpu")
        found, ignored = wp.zeros(n, dtype=wp.mat33, device="cpu"), wp.zeros(n, dtype=float, device="cpu")
        wp.launch(
            answer,
            n,
            inputs=[int(kind), *arrays, RHEOLOGY],
            outputs=outputs,
            adj_inputs=[int(kind), found, ignored, RHEOLOGY],
            adj_outputs=given,
            adjoint=True,
            device="cpu",
        )
        true = slope(lambda F, f=function: f(kind, F), F, weight)
        assert np.abs(found.numpy() - true).max() < 2e-3 * np.abs(true).max(), name
