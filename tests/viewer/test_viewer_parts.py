"""The viewer's parts without a browser: packing, colours, picking, queues."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.column import make_column, make_interaction
from torch import Tensor

pytest.importorskip("viser", reason="the extra 'view' is not installed")


from gausim.core import Frame
from gausim.interaction.interaction import Interaction
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.spherical_harmonics import spherical_harmonics_basis
from gausim.viewer.coloring import BASE, MASS, SPEED, STRAIN, VIEW, Painter
from gausim.viewer.pipeline import Worker
from gausim.viewer.pointer import first_hit, in_rectangle
from gausim.viewer.splats import Placing, half_covariances, pack


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
