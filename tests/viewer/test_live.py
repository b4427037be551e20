"""The viewer without a browser: its simulating thread, packing, colours, picking and queues."""

import asyncio
import threading
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from helpers.column import make_column, make_interaction

pytest.importorskip("viser", reason="the extra 'view' is not installed")

from torch import Tensor

from gausim.core import ConfigError, Frame
from gausim.interaction import interaction as interaction_module
from gausim.interaction.interaction import Interaction
from gausim.interaction.replay import replay
from gausim.interaction.selections import Unit, Whole
from gausim.interaction.session import Force, Gravity, Impulse, Pin, Release, Reset, Wind
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.orbit import orbit_cameras
from gausim.ops.spherical_harmonics import spherical_harmonics_basis
from gausim.viewer.camera_panel import CameraPanel
from gausim.viewer.coloring import BASE, MASS, SPEED, STRAIN, VIEW, Painter
from gausim.viewer.live import Live
from gausim.viewer.pipeline import Worker
from gausim.viewer.pointer import Pointer, first_hit, in_rectangle
from gausim.viewer.shown import LIVE, Take
from gausim.viewer.splats import SIZE, Placing, half_covariances, pack
from gausim.viewer.subject import Subject


@pytest.fixture
def one() -> Live:
    return Live(make_interaction(keep=None), lambda _: None)


def test_a_dragged_pin_takes_its_hand_along(one: Live) -> None:
    interaction = one.interaction
    scene, placing = interaction.scene, Placing.of(interaction.scene)
    pointer = Pointer(MagicMock(), one, placing)
    pointer.follow(one.shown())
    followed: list[tuple[float, float, float]] = []
    pointer.hand_moved = lambda hand, to: followed.append(to)

    def drag(kernel: int, *way: tuple[str, tuple[float, float, float]], handle: int = 0) -> None:
        begun = placing.to_page(interaction.frame.positions[kernel]).double().numpy()
        for phase, moved in way:
            start = placing.to_page(interaction.frame.positions[kernel]).double().numpy()
            camera = SimpleNamespace(position=start - np.array([0.0, 0.0, SIZE]))  # looks up from below
            end = begun + placing.scale * np.array(moved)
            asyncio.run(
                pointer._dragged(
                    SimpleNamespace(
                        client=SimpleNamespace(camera=camera), client_id=0, phase=phase, instance_index=handle,
                        start_position=start, end_position=end,
                    )
                )
            )  # fmt: skip
            one._take_commands(0.0)
            one.advance()

    low = int(scene.means[:, 2].masked_fill(~scene.pinned, torch.inf).argmin())
    drag(low, ("start", (0.0, 0.0, 0.0)), ("update", (0.1, 0.0, 0.0)), ("end", (0.1, 0.0, 0.0)))
    for _ in range(6):
        one.advance()
    assert not one.message and not interaction.acting
    moved = interaction.frame.positions - scene.means
    torch.testing.assert_close(moved[scene.pinned], torch.tensor([0.1, 0.0, 0.0]).expand(int(scene.pinned.sum()), 3))
    assert followed and followed[-1] == pytest.approx((0.1, 0.0, 0.0), abs=1e-5)
    free = int(scene.means[:, 2].argmax())  # a pin's own handle moves its hand, whatever is in front
    pins = len(pointer._centres(scene.means)) - 1
    drag(free, ("start", (0.0, 0.0, 0.0)), ("update", (0.0, 0.1, 0.0)), ("end", (0.0, 0.1, 0.0)), handle=pins)
    assert interaction.session().entries[-1].event.to == pytest.approx((0.1, 0.1, 0.0), abs=1e-5)  # goes on from there


def test_what_was_done_is_played_back_bit_for_bit_with_its_own_gravity_and_gusts(one: Live) -> None:
    one.interaction = make_interaction(gravity=2.0, keep=None)
    one.interaction.seed = 3
    one.begin()
    for number in range(12):
        if number == 2:
            one.act(Force(Unit(1, 3), (1.0, 0, 0), 2.0, name="drag-0"))
        if number == 5:
            one.act(Release("drag-0"))
            one.act(Wind((0.0, 1.0, 0.0), 0.5, gusts=0.5))
        if number == 8:
            one.act(Pin(Unit(1, 0)))
            one.act(Impulse(Whole(), (0.0, 0.0, 1.0), 0.05))
        one.advance()
    recorded, session = one.interaction.trajectory(), one.interaction.session()
    one = Live(make_interaction(keep=None), lambda _: None)
    one.replay(session)
    with pytest.raises(ConfigError, match="played back"):
        one.act(Reset())
    while one.playing:
        one.advance()
    assert "over" in one.message
    again = one.interaction.trajectory()
    for name in ("positions", "deformation_gradients"):
        assert torch.equal(getattr(again, name), getattr(recorded, name))
    assert one.interaction.session() == session
    assert torch.equal(replay(one.interaction, session).positions, recorded.positions)


def test_the_timeline_goes_back_and_play_goes_on_from_the_end(one: Live) -> None:
    one.act(Gravity((1.0, 0.0, 0.0), 1.0))
    for _ in range(6):
        one.advance()
    last = one.interaction.frame.positions
    one.scrub(2)
    assert not one.playing and one.shown().number == 2 and one.shown().last == 6
    assert not torch.equal(one.shown().frame.positions, last)
    one.play()
    assert torch.equal(one.shown().frame.positions, last)
    one.reset()
    assert one.shown().last == 0 and torch.equal(one.shown().frame.positions, one.interaction.scene.means)
    for wrong in (-5, 10**6):
        one.scrub(wrong)
        assert one.shown().number == 0


def test_divergence_stops_the_simulation_with_a_message_and_a_reset_helps(one: Live, monkeypatch) -> None:
    monkeypatch.setattr(interaction_module, "FARTHEST", 1e-4)
    one.act(Gravity((1.0, 0.0, 0.0), 2.0))
    one.start()
    while one.playing:
        time.sleep(0.01)
    assert "stopped" in one.message and "kernel" in one.message
    one.do(one.play)
    time.sleep(0.2)
    assert one.is_alive() and not one.playing
    one.do(one.reset)
    while one.message:
        time.sleep(0.01)
    one.do(one.play)
    while one.interaction.frame_number < 3:
        time.sleep(0.01)
    assert one.interaction.broken is None
    one.stop()
    one.join(5)


def test_time_stands_while_nobody_looks() -> None:
    watched = threading.Event()
    one = Live(make_interaction(), lambda _: None, watched=watched.is_set)
    one.start()
    time.sleep(0.4)
    assert one.interaction.tick == 0
    watched.set()
    while one.interaction.tick < 2:
        time.sleep(0.01)
    one.stop()
    one.join(5)


def test_takes_are_played_in_their_own_time_and_cannot_be_pushed() -> None:
    interaction = make_interaction()
    trajectory = make_interaction()._dynamics.rollout(interaction.state, 5)
    one = Live(interaction, lambda _: None, takes=[Take("Predicted: a", lambda: trajectory)])
    one.choose("Predicted: a")
    with pytest.raises(ConfigError, match=LIVE):
        one.act(Reset())
    for number in range(1, 8):
        one.advance()
        assert one.shown().number == number % 6 and one.shown().last == 5
    assert interaction.tick == 0


@pytest.mark.parametrize(("size", "spread"), [(1e-3, 0.0), (1.0, 0.5), (1.0, 4.0), (1e3, 4.0)])
def test_rounded_covariances_stay_positive_definite_and_near(size: float, spread: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scales = np.log(size) + spread * torch.randn(4000, 3, generator=generator)
    covars = covariance_from_scales(scales, torch.randn(4000, 4, generator=generator))
    packed = half_covariances(covars)
    assert packed.dtype == np.float16 and np.isfinite(packed).all()
    xx, xy, xz, yy, yz, zz = packed.astype(np.float64).T
    assert np.linalg.eigvalsh(np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)).min() > 0
    if spread < 1:
        largest = covars.diagonal(dim1=-2, dim2=-1).amax(-1)
        upper = covars.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        error = (torch.from_numpy(packed.astype(np.float32)) - upper).abs().amax(-1)
        assert float((error / largest.clamp_min(1e-4)).max()) < 0.006


def test_a_packed_kernel_reads_as_viser_writes_it() -> None:
    scene = make_column()
    placing = Placing.of(scene)
    covars = covariance_from_scales(scene.log_scales, scene.quats)
    rgb = torch.rand(scene.count, 3, generator=torch.Generator().manual_seed(1))
    opacities = torch.sigmoid(scene.opacity_logits)
    buffer = pack(scene.means, covars, rgb, opacities, placing)
    assert buffer.shape == (scene.count, 8) and buffer.dtype == np.uint32
    assert torch.equal(torch.from_numpy(buffer[:, :3].copy().view(np.float32)), placing.to_page(scene.means))
    rgba = buffer[:, 7:].copy().view(np.uint8)
    assert np.abs(rgba[:, :3] - rgb.numpy() * 255).max() <= 0.51 and (rgba[:, 3] == 128).all()
    assert (buffer[:, 3] == 0).all()


@pytest.fixture
def painter() -> tuple[Painter, Interaction]:
    interaction = make_interaction()
    return Painter(interaction.scene, interaction.units, interaction.masses), interaction


def painted(painter: Painter, interaction: Interaction, mode: str, eye: Tensor) -> tuple[Tensor, Tensor]:
    frame, still = interaction.frame, torch.zeros(interaction.scene.count)
    covars, rgb, legend = painter(frame, interaction.unit_of_kernel, still, mode, eye)
    assert legend.text and torch.isfinite(rgb).all() and rgb.shape == (interaction.scene.count, 3)
    return covars, rgb


def test_every_mode_colours_every_kernel(painter: tuple[Painter, Interaction]) -> None:
    paint, interaction = painter
    assert {VIEW, BASE, STRAIN, SPEED, MASS} <= set(paint.modes) and len(paint.modes) == 5 + len(interaction.units)
    eye = torch.tensor([0.0, -3.0, 1.0])
    scene = interaction.scene
    rest = covariance_from_scales(scene.log_scales, scene.quats)
    seen = {}
    for mode in paint.modes:
        covars, seen[mode] = painted(paint, interaction, mode, eye)
        assert torch.allclose(covars, rest, atol=1e-7)
        assert float(seen[mode].min()) >= 0
    away = torch.nn.functional.normalize(scene.means - eye, dim=-1)
    basis = spherical_harmonics_basis(1, away)
    expected = (torch.einsum("kb,kbc->kc", basis, scene.sh) + 0.5).clamp_min(0)
    assert torch.allclose(seen[VIEW], expected, atol=1e-5)
    other = painted(paint, interaction, VIEW, -eye)[1]
    assert not torch.allclose(other, seen[VIEW], atol=1e-3)
    assert torch.equal(painted(paint, interaction, BASE, -eye)[1], seen[BASE])


def test_strain_is_the_largest_logarithm_of_a_stretch(painter: tuple[Painter, Interaction]) -> None:
    paint, interaction = painter
    deformation_gradients = interaction.frame.deformation_gradients.clone()
    unit = int(interaction.unit_of_kernel[interaction.scene.simulated & ~interaction.scene.pinned][0])
    deformation_gradients[unit] = torch.diag(torch.tensor([1.0, 0.5, 1.5]))
    frame = Frame(interaction.frame.positions, deformation_gradients, interaction.frame.rotations)
    still = torch.zeros(interaction.scene.count)
    _, rgb, legend = paint(frame, interaction.unit_of_kernel, still, STRAIN, torch.ones(3))
    assert legend.high == pytest.approx(np.log(2.0), rel=1e-5)
    strained = interaction.unit_of_kernel == unit
    assert not torch.allclose(rgb[strained][0], rgb[~strained][0])


def camera() -> SimpleNamespace:
    """At (0, -5, 0), looking along +y, up +z: x right, z up."""
    half = float(np.sqrt(0.5))
    return SimpleNamespace(wxyz=(half, -half, 0.0, 0.0), position=(0.0, -5.0, 0.0), fov=np.pi / 2, aspect=2.0)


def test_a_ray_takes_the_first_kernel_and_a_rectangle_what_is_seen() -> None:
    points = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [-9.0, 0, 0], [0, 0, 2.0], [0, -9.0, 0]])
    everything = in_rectangle(points, camera(), (0.0, 0.0), (1.0, 1.0))
    assert everything.tolist() == [True, True, True, True, False]
    right = in_rectangle(points, camera(), (0.55, 0.4), (1.0, 0.6))
    assert right.tolist() == [False, True, False, False, False]
    above = in_rectangle(points, camera(), (0.4, 0.0), (0.6, 0.45))
    assert above.tolist() == [False, False, False, True, False]
    points = torch.tensor([[0.0, 3, 0], [0.05, 1, 0], [0.0, -2, 0], [1.0, 1, 0]])
    reach, free = torch.full((4,), 0.1), torch.ones(4, dtype=torch.bool)
    assert first_hit(points, reach, (0, 0, 0), (0, 2, 0), free) == 1
    assert first_hit(points, reach, (0, 0, 0), (0, 2, 0), torch.tensor([True, False, True, True])) == 0
    assert first_hit(points, reach, (0, 0, 0), (0, 0, 1), free) is None
    assert first_hit(points, reach, (0, 0, 0), (0, 0, 0), free) is None


def test_a_worker_takes_the_newest_item_and_outlives_an_error() -> None:
    done, seen = threading.Event(), list[int]()

    def work(number: int) -> None:
        seen.append(number)
        if number == 99:
            raise ValueError("one bad frame")
        done.set()

    worker = Worker("test", work)
    for number in range(100):
        worker.put(number)
    worker.start()
    while worker.failures == 0:
        time.sleep(0.01)
    worker.put(7)
    assert done.wait(10) and worker.failures == 1 and seen == [99, 7]
    worker.stop()
    worker.join(5)
    assert not worker.is_alive()


def test_a_client_looks_from_the_cameras_of_the_data_set() -> None:
    interaction, server, event = make_interaction(), MagicMock(), MagicMock()
    placing, means = Placing.of(interaction.scene), interaction.scene.means
    cameras = orbit_cameras(means, azimuths=[0.0, 90.0], size=(64, 48))
    CameraPanel(server, placing, Subject("a column", interaction, cameras=cameras))
    choice = server.gui.add_dropdown.return_value
    choice.value = cameras.names[1]
    asyncio.run(choice.on_update.call_args[0][0](event))
    for number, camera in enumerate((server.initial_camera, event.client.camera)):
        np.testing.assert_allclose(camera.position, placing.to_page(cameras.centers[number]), atol=1e-5)
        ahead = (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position)
        np.testing.assert_allclose(ahead, cameras.viewmats[number, 2, :3], atol=1e-5)
        assert camera.fov == pytest.approx(2 * np.arctan(24 / float(cameras.Ks[number, 1, 1])))
