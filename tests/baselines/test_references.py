"""References: linear autoregression, rigid flight, and kernels that follow hands."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.plain import plain_scene
from scipy.spatial.transform import Rotation

from gausim.baselines.linear_ar import RIDGES, choose_linear_ar, fit_linear_ar
from gausim.baselines.references import ballistic_motion, hand_weights, hands_motion, rigid_fit
from gausim.core import DataError, Floor, GaussianScene, HandPath, SimState, Surroundings

FPS = 24.0


def cube(*, floor: float | None = None, gravity: float | None = None) -> GaussianScene:
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 0.3])] * 3) * torch.tensor([1.0, 1.2, 0.8])
    plane = None if floor is None else Floor((0.0, 0.0, floor), (0.0, 0.0, 1.0))
    pull = None if gravity is None else (0.0, 0.0, -gravity)
    return plain_scene(corners + 2.0, surroundings=Surroundings(free=True, gravity=pull, floor=plane))


def placed(body: GaussianScene, shift: list[float], turn: list[float]) -> torch.Tensor:
    centre = body.means.mean(0)
    rotation = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix()).float()
    return (body.means - centre) @ rotation.T + centre + torch.tensor(shift)


def test_rigid_fit_finds_rotation_and_centre_of_a_noisy_body() -> None:
    body = cube()
    rotation, centre = rigid_fit(body.means, placed(body, [0.1, 0.2, 0.3], [0.2, -0.4, 0.1]))
    expected = torch.from_numpy(Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix())
    torch.testing.assert_close(rotation, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(centre.float(), body.means.mean(0) + torch.tensor([0.1, 0.2, 0.3]))


def test_flight_is_a_parabola_with_constant_spin() -> None:
    body = cube(gravity=5.0)

    def at(frame: int) -> torch.Tensor:
        t = frame / FPS
        return placed(body, [0.3 * t, -0.1 * t, 0.5 * t - 2.5 * t * t], [0.0, 0.9 * t, 0.0])

    flown = ballistic_motion(body, SimState(at(1), at(0)), fps=FPS, steps=20)
    for frame in (0, 7, 20):
        torch.testing.assert_close(flown.positions[frame], at(frame + 1), atol=2e-5, rtol=0)
    spin = Rotation.from_rotvec([0.0, 0.9 * 21 / FPS, 0.0]).as_matrix()
    torch.testing.assert_close(flown.rotations[20, 0], torch.from_numpy(spin).float(), atol=1e-5, rtol=0)


def test_flight_stops_at_the_floor_for_good_but_may_leave_it() -> None:
    body = cube(floor=1.5, gravity=5.0)
    still = placed(body, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    fallen = ballistic_motion(body, SimState(still, still), fps=FPS, steps=30).positions
    gap = fallen[..., 2].amin(1) - 1.5
    assert gap.min() > -1e-6 and gap[-1] < 1e-6
    landed = int((gap < 1e-6).nonzero()[0, 0])
    assert landed / FPS == pytest.approx(math.sqrt(2 * 0.5 / 5.0), abs=1.5 / FPS)
    assert torch.equal(fallen[landed], fallen[-1])
    # Squeezed below the floor, but on its way up.
    low, lower = placed(body, [0, 0, -0.52], [0, 0, 0]), placed(body, [0, 0, -0.6], [0, 0, 0])
    risen = ballistic_motion(body, SimState(low, lower), fps=FPS, steps=3).positions
    assert risen[3, 0, 2] > still[0, 2] - 0.52 + 0.1


def beam(turn: float = 0.0) -> tuple[GaussianScene, HandPath]:
    """A beam along x from 0 to 1, held at its ends by two hands of four points each, which turn against each other."""
    x = torch.linspace(0, 1, 11)
    means = torch.cat([torch.stack((x, torch.full_like(x, y), torch.full_like(x, z)), 1)
                       for y in (-0.01, 0.01) for z in (-0.01, 0.01)])  # fmt: skip
    hand = torch.where(means[:, 0] < 0.05, 0, torch.where(means[:, 0] > 0.95, 1, -1))
    body = plain_scene(means, pinned=hand >= 0, hand=hand)
    frames = []
    for part in (0.0, 1.0):
        moved = means[hand >= 0].clone()
        for number, side in ((0, 1.0), (1, -1.0)):
            own = hand[hand >= 0] == number
            rotation = torch.from_numpy(Rotation.from_rotvec([0, -side * part * turn, 0]).as_matrix()).float()
            centre = moved[own].mean(0)
            moved[own] = (moved[own] - centre) @ rotation.T + centre + part * torch.tensor([0.0, 0.1, 0.0])
        frames.append(moved)
    return body, HandPath.of(torch.stack(frames), hand[hand >= 0])


def test_kernels_follow_hands_as_a_beam_bends() -> None:
    body, hands = beam()
    followed = hands_motion(body, hands, fps=FPS, steps=1)
    torch.testing.assert_close(followed.positions[0], body.means)
    torch.testing.assert_close(followed.positions[1], body.means + torch.tensor([0.0, 0.1, 0.0]))
    # Ends turned by theta and -theta: the middle of a beam rises by theta L / 4, everywhere by theta x (1 - x).
    turn = 0.05
    body, hands = beam(turn)
    followed = hands_motion(body, hands, fps=FPS, steps=1)
    rise = (followed.positions[1] - body.means)[:, 2]
    free = body.hand < 0
    x = body.means[free, 0]
    torch.testing.assert_close(rise[free], turn * x * (1 - x), atol=2e-3 * turn, rtol=0.03)
    held = ~free
    pose = hands.pose(1)
    torch.testing.assert_close(followed.positions[1, held], pose.move(body.means[held], body.hand[held]))
    assert followed.rotations[1][free & (body.means[:, 0] == 0.5)].sub(torch.eye(3)).abs().max() < 1e-5
    body, hands = beam()
    hand = torch.where(body.hand == 1, -1, body.hand)
    weights = hand_weights(replace(body, hand=hand))
    assert weights.shape == (44, 1)
    torch.testing.assert_close(weights[:, 0], 1 - body.means[:, 0], atol=0.02, rtol=0)
    assert weights[body.pinned & (hand < 0)].abs().max() == 0


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
