"""Static reconstruction on a tiny scene that our own renderer drew, and the parts it is made of."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from gausim.cli.main import main
from gausim.core import Cameras, ConfigError, DataError, GaussianScene
from gausim.data.images import write_rgba
from gausim.engine.reconstruction import ReconstructionOptions, reconstruct
from gausim.engine.splats import LearningRates, Splats
from gausim.engine.stills import ImageSet, draw_rest, measure, reduced
from gausim.io.ply import load_scene
from gausim.io.transforms import write_transforms
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw

SIZE = 40
TINY = ReconstructionOptions(kernels=160, iterations=400, hull_resolution=24, rounds=4, rates=LearningRates(means=1e-3))


def cameras_around(count: int) -> Cameras:
    viewmats = []
    for i in range(count):
        z = torch.tensor(0.9 - 1.6 * i / count)
        angle = torch.tensor(2.39996 * i)
        ring = (1 - z * z).sqrt()
        away = torch.stack((angle.cos() * ring, angle.sin() * ring, z))
        right = torch.nn.functional.normalize(torch.linalg.cross(-away, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.stack((right, torch.linalg.cross(-away, right), -away))
        viewmat[2, 3] = 3.0
        viewmats.append(viewmat)
    K = torch.tensor([[50.0, 0, SIZE / 2], [0, 50.0, SIZE / 2], [0, 0, 1]])
    names = tuple(f"still/{i}.png" for i in range(count))
    return Cameras(torch.stack(viewmats), K.repeat(count, 1, 1), SIZE, SIZE, names)


def true_scene() -> GaussianScene:
    """Two coloured balls of kernels, one above the other."""
    g = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(150, 3, generator=g), dim=-1)
    upper = torch.arange(150) < 60
    means = torch.where(upper[:, None], 0.3 * direction + torch.tensor([0.1, 0, 0.5]), 0.5 * direction)
    colors = torch.where(upper[:, None], torch.tensor([0.9, 0.3, 0.2]), torch.tensor([0.2, 0.5, 0.8]))
    colors = (colors + 0.15 * means).clamp(0, 1)
    return GaussianScene.create(
        means=means,
        log_scales=torch.full((150, 3), -2.7),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(150, 4),
        opacity_logits=torch.full((150,), 4.0),
        sh=((colors - 0.5) / 0.28209479)[:, None],
    )


@pytest.fixture(scope="module")
def stills() -> ImageSet:
    """Straight-alpha stills of the true scene."""
    scene, cameras = true_scene(), cameras_around(24)
    identity, unit = torch.eye(3)[None, None], torch.zeros(scene.count, dtype=torch.int64)
    drawn = draw(CpuRenderer(threads=1), scene, scene.means[None], identity, identity, unit, cameras)
    rgb, alpha = drawn.rgb[0], drawn.alpha[0][..., None]
    alpha = torch.where(alpha < 0.02, 0.0, alpha)
    rgba = torch.cat((rgb / alpha.clamp_min(0.02), alpha), -1).clamp(0, 1)
    return ImageSet("stills", (rgba * 255).round().to(torch.uint8), cameras)


@pytest.fixture(scope="module")
def fitted(stills: ImageSet) -> GaussianScene:
    return reconstruct([stills.select(range(20))], CpuRenderer(threads=1), TINY, name="balls")


def test_stills_left_out_are_met(stills: ImageSet, fitted: GaussianScene) -> None:
    left_out, renderer = stills.select(range(20, 24)), CpuRenderer(threads=1)
    start = reconstruct([stills.select(range(20))], renderer, ReconstructionOptions(kernels=160, iterations=1))
    before, after = measure(start, renderer, left_out), measure(fitted, renderer, left_out)
    assert after["psnr"] > 28 and after["psnr"] > before["psnr"] + 5
    assert after["psnr_foreground"] > 24
    assert after["ssim"] > before["ssim"]


def test_kernels_stay_within_the_budget_and_the_object(fitted: GaussianScene) -> None:
    assert 100 < fitted.count <= 160
    assert fitted.sh_degree == 1 and fitted.sh[:, 1:].abs().max() > 0
    distance = torch.minimum(
        (fitted.means - torch.tensor([0.1, 0, 0.5])).norm(dim=-1) - 0.3, fitted.means.norm(dim=-1) - 0.5
    )
    assert float(distance.max()) < 0.35  # the hull of twenty masks, a fifth wider than the body, plus one voxel
    assert fitted.simulated.all() and fitted.foreground.all() and not fitted.pinned.any()
    ratio = (fitted.log_scales.amax(-1) - fitted.log_scales.amin(-1)).exp()
    assert float(ratio.quantile(0.9)) < 6


def test_same_seed_same_scene(stills: ImageSet) -> None:
    short = ReconstructionOptions(kernels=60, iterations=25, hull_resolution=16, rounds=3)
    other = ReconstructionOptions(kernels=60, iterations=25, hull_resolution=16, rounds=3, seed=1)
    first, again, third = (reconstruct([stills], CpuRenderer(threads=1), o) for o in (short, short, other))
    assert torch.equal(first.means, again.means) and torch.equal(first.sh, again.sh)
    assert first.means.shape != third.means.shape or not torch.equal(first.means, third.means)


def test_given_points_replace_the_hull_as_start(stills: ImageSet) -> None:
    options = ReconstructionOptions(kernels=40, iterations=1, hull_resolution=16, start_share=1.0, rounds=1)
    points = true_scene().means[::2]
    scene = reconstruct([stills], CpuRenderer(threads=1), options, points=points)
    assert torch.cdist(scene.means, points).amin(1).max() < 0.02


def test_empty_hull_is_refused(stills: ImageSet) -> None:
    images = stills.images.clone()
    images[3, ..., 3] = 0
    with pytest.raises(DataError, match="visual hull of 24 masks is empty"):
        reconstruct([ImageSet("stills", images, stills.cameras)], CpuRenderer(threads=1), TINY)


@pytest.mark.parametrize("change", [{"kernels": 0}, {"iterations": 0}, {"sh_degree": 4}])
def test_options_out_of_range_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        ReconstructionOptions(**change)


def test_reduced_images_show_the_same_scene(stills: ImageSet) -> None:
    half = reduced(stills, (SIZE // 2, SIZE // 2), share=0.3)
    assert half.images.shape == (24, SIZE // 2, SIZE // 2, 4) and half.share == 0.3
    renderer, scene = CpuRenderer(threads=1), true_scene()
    large = draw_rest(scene, renderer, stills.cameras).reshape(24, SIZE // 2, 2, SIZE // 2, 2, 3).mean((2, 4))
    alpha = half.images[..., 3:].float() / 255
    assert (half.images[..., :3].float() / 255 * alpha - large).abs().max() < 0.02
    # The pixel filter is the same in pixels, so the small rendering is softer; a wrong K would give 0.1 and more.
    assert (draw_rest(scene, renderer, half.cameras) - large).abs().mean() < 0.04


def test_split_and_keep_carry_parameters_and_moments() -> None:
    g = torch.Generator().manual_seed(0)
    splats = Splats(
        torch.randn(6, 3, generator=g),
        torch.rand(6, 3, generator=g),
        torch.full((6,), 0.1),
        sh_degree=1,
        opacity=0.5,
        rates=LearningRates(),
        extent=1.0,
    )
    with torch.no_grad():
        splats["log_scales"][2, 1] += 1.0
    (splats["means"] * torch.arange(1.0, 7.0)[:, None]).sum().backward()
    splats.step({"": 1.0})
    before = splats["means"].detach().clone()
    moments = splats.optimizer.state[splats["means"]]["exp_avg"].clone()
    assert splats.pull[5] > splats.pull[0] > 0
    splats.split(torch.tensor([2]))
    assert splats.count == 7
    means = splats["means"].detach()
    assert torch.allclose((means[2] + means[6]) / 2, before[2], atol=1e-6)
    assert torch.allclose((means[2] - means[6]).abs(), torch.tensor([0.0, 1.2 * 0.1 * 2.71828, 0.0]), atol=1e-3)
    assert torch.allclose(splats["log_scales"][2].detach(), splats["log_scales"][6].detach())
    state = splats.optimizer.state[splats["means"]]["exp_avg"]
    assert torch.equal(state[:6], moments) and not state[6].any()
    splats.keep(torch.arange(7) != 0)
    assert splats.count == 6 and torch.equal(splats["means"].detach()[0], before[1])
    assert torch.equal(splats.optimizer.state[splats["means"]]["exp_avg"][:5], moments[1:])
    (splats["means"] ** 2).sum().backward()
    splats.step({"": 1.0})
    assert not torch.equal(splats["means"].detach()[0], before[1])


def test_command_writes_scene_masks_figures_and_picture(
    stills: ImageSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    for i, image in enumerate(stills.images):
        write_rgba(tmp_path / "images" / f"{i:02d}.png", image)
    entries = [{"file_path": f"images/{i:02d}.png"} for i in range(24)]
    write_transforms(tmp_path / "transforms.json", stills.cameras, entries)
    command = ["reconstruct", "--transforms", str(tmp_path / "transforms.json")]
    command += ["--out", str(tmp_path / "out" / "s.ply")]
    assert main([*command, "--kernels", "80", "--iterations", "40", "--pin-below", "z=-0.2"]) == 0
    scene = load_scene(tmp_path / "out" / "s.ply")
    assert torch.equal(scene.pinned, scene.means[:, 2] < -0.2) and scene.pinned.any()
    record = json.loads((tmp_path / "out" / "s.json").read_text())
    assert record["measured"]["stills left out"]["images"] == 2
    assert record["kernels"] == scene.count and record["options"]["iterations"] == 40
    assert (tmp_path / "out" / "s.png").stat().st_size > 1000
    assert "stills left out" in capsys.readouterr().out
    assert main([*command, "--kernels", "80", "--iterations", "20", "--pin-below", "z=-9"]) == 2
    assert "holds none of" in capsys.readouterr().err


def test_command_needs_one_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct"]) == 2
    assert "either ROOT" in capsys.readouterr().err


@pytest.mark.slow
def test_real_stills_are_met(data_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene.ply"
    command = ["reconstruct", str(data_root / "bunny"), "--out", str(out), "--iterations", "1500"]
    assert main([*command, "--pin-below", "z=0.33"]) == 0
    figures = json.loads(out.with_suffix(".json").read_text())["measured"]["stills left out"]
    assert figures["psnr"] > 30 and figures["psnr_foreground"] > 26
