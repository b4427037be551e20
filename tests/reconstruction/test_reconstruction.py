"""Static reconstruction on a tiny scene that our own renderer drew, and the parts it is made of."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.plain import cameras_at, plain_scene
from torch import Tensor

from gausim.cli.main import main
from gausim.core import Cameras, DataError, GaussianScene
from gausim.data.images import write_rgba
from gausim.io.ply import load_scene
from gausim.io.transforms import write_transforms
from gausim.reconstruction.reconstruction import ReconstructionOptions, reconstruct
from gausim.reconstruction.splats import LearningRates, Splats
from gausim.reconstruction.stills import ImageSet, measure, reduced
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw_still

SIZE = 40
RENDERER = CpuRenderer(threads=1)
TINY = ReconstructionOptions(kernels=160, iterations=400, hull_resolution=24, rates=LearningRates(means=1e-3))


def cameras_around(count: int) -> Cameras:
    z, angle = 0.9 - 1.6 * torch.arange(count) / count, 2.39996 * torch.arange(count)
    ring = (1 - z * z).sqrt()
    eyes = 3.0 * torch.stack((angle.cos() * ring, angle.sin() * ring, z), -1)
    return cameras_at(eyes, (0.0, 0.0, 0.0), focal=50.0, size=SIZE, names=[f"still/{i}.png" for i in range(count)])


def true_scene() -> GaussianScene:
    """Two coloured balls of kernels, one above the other."""
    g = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(150, 3, generator=g), dim=-1)
    upper = torch.arange(150) < 60
    means = torch.where(upper[:, None], 0.3 * direction + torch.tensor([0.1, 0, 0.5]), 0.5 * direction)
    colors = torch.where(upper[:, None], torch.tensor([0.9, 0.3, 0.2]), torch.tensor([0.2, 0.5, 0.8]))
    colors = (colors + 0.15 * means).clamp(0, 1)
    return plain_scene(means, log_scale=-2.7, opacity=4.0, sh=((colors - 0.5) / 0.28209479)[:, None])


@pytest.fixture(scope="module")
def stills() -> ImageSet:
    """Straight-alpha stills of the true scene."""
    scene, cameras = true_scene(), cameras_around(24)
    drawn = draw_still(RENDERER, scene, cameras)
    rgb, alpha = drawn.rgb[0], drawn.alpha[0][..., None]
    alpha = torch.where(alpha < 0.02, 0.0, alpha)
    rgba = torch.cat((rgb / alpha.clamp_min(0.02), alpha), -1).clamp(0, 1)
    return ImageSet("stills", (rgba * 255).round().to(torch.uint8), cameras)


@pytest.fixture(scope="module")
def fitted(stills: ImageSet) -> GaussianScene:
    return reconstruct([stills.select(range(20))], RENDERER, TINY, name="balls")


def test_stills_left_out_are_met(stills: ImageSet, fitted: GaussianScene) -> None:
    left_out = stills.select(range(20, 24))
    start = reconstruct([stills.select(range(20))], RENDERER, ReconstructionOptions(kernels=160, iterations=1))
    before, after = measure(start, RENDERER, left_out), measure(fitted, RENDERER, left_out)
    assert after["psnr"] > 28 and after["psnr"] > before["psnr"] + 5
    assert after["psnr_foreground"] > 24
    assert after["ssim"] > before["ssim"]


def test_kernels_stay_within_the_budget_and_the_object(fitted: GaussianScene) -> None:
    assert 100 < fitted.count <= 160
    assert fitted.sh_degree == 1 and fitted.sh[:, 1:].abs().max() > 0
    upper = (fitted.means - torch.tensor([0.1, 0, 0.5])).norm(dim=-1) - 0.3
    distance = torch.minimum(upper, fitted.means.norm(dim=-1) - 0.5)
    assert float(distance.max()) < 0.35  # the hull of twenty masks, a fifth wider than the body, plus one voxel
    assert fitted.simulated.all() and fitted.foreground.all() and not fitted.pinned.any()
    ratio = (fitted.log_scales.amax(-1) - fitted.log_scales.amin(-1)).exp()
    assert float(ratio.quantile(0.9)) < 6


def test_it_stops_where_more_steps_do_not_help(stills: ImageSet) -> None:
    still = LearningRates(means=0, log_scales=0, quats=0, opacity=0, color=0, color_rest=0)
    options = replace(TINY, iterations=100, patience=2, rates=still, random_background=False)
    steps: list[int] = []
    reconstruct([stills.select([0])], RENDERER, options, progress=lambda run: steps.append(run.done))
    assert steps[-1] == 71 + 3 * 5  # the first look, and two that are not better


def test_masks_that_miss_a_part_are_outvoted(stills: ImageSet) -> None:
    images = stills.images.clone()
    images[3, ..., 3] = 0
    with pytest.raises(DataError, match="visual hull of 24 masks is empty"):
        reconstruct([ImageSet("stills", images, stills.cameras)], RENDERER, TINY)
    allowed = replace(TINY, missing_masks=0.05, iterations=1)
    scene = reconstruct([ImageSet("stills", images, stills.cameras)], RENDERER, allowed)
    whole = reconstruct([stills], RENDERER, allowed)
    assert scene.count > 50
    assert (scene.means.amin(0) - whole.means.amin(0)).abs().max() < 0.1


def test_reduced_images_show_the_same_scene(stills: ImageSet) -> None:
    half = reduced(replace(stills, weight=0.3), 0.5)
    assert half.images.shape == (24, SIZE // 2, SIZE // 2, 4) and half.weight == 0.3
    drawn = (draw_still(RENDERER, true_scene(), cameras) for cameras in (stills.cameras, half.cameras))
    large, small = (images.rgb[0].clamp(0, 1) for images in drawn)
    large = large.reshape(24, SIZE // 2, 2, SIZE // 2, 2, 3).mean((2, 4))
    alpha = half.images[..., 3:].float() / 255
    assert (half.images[..., :3].float() / 255 * alpha - large).abs().max() < 0.02
    # The pixel filter is the same in pixels, so the small rendering is softer; a wrong K would give 0.1 and more.
    assert (small - large).abs().mean() < 0.04


def test_split_and_keep_carry_parameters_and_moments() -> None:
    g = torch.Generator().manual_seed(0)
    splats = Splats(
        torch.randn(6, 3, generator=g), torch.rand(6, 3, generator=g), torch.full((6,), 0.1), sh_degree=1,
        opacity=0.5, rates=LearningRates(), extent=1.0,
    )  # fmt: skip
    with torch.no_grad():
        splats["log_scales"][2, 1] += 1.0
    (splats["means"] * torch.arange(1.0, 7.0)[:, None]).sum().backward()
    splats.step({"": 1.0})
    before = splats["means"].detach().clone()
    moments = splats.optimizer.state[splats["means"]]["exp_avg"].clone()
    assert splats.seen.all()
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


def written(images: ImageSet, folder: Path, write: Callable[[Path, Tensor], object]) -> list[str]:
    """Writes images with their poses; the beginning of a command that reconstructs them."""
    names = [f"images/{i:02d}.png" for i in range(len(images.images))]
    (folder / "images").mkdir()
    for name, image in zip(names, images.images, strict=True):
        write(folder / name, image)
    write_transforms(folder / "transforms.json", images.cameras, [{"file_path": name} for name in names])
    return ["reconstruct", "--transforms", str(folder / "transforms.json")]


def test_command_writes_scene_masks_figures_and_picture(stills: ImageSet, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out" / "s.ply"
    command = [*written(stills, tmp_path, write_rgba), "--out", str(out), "--kernels", "80"]
    assert main([*command, "--iterations", "40", "--pin", "below z=-0.2"]) == 0
    scene = load_scene(out)
    assert torch.equal(scene.pinned, scene.means[:, 2] < -0.2) and scene.pinned.any()
    record = json.loads(out.with_suffix(".json").read_text())
    assert record["measured"]["stills left out"]["images"] == 2
    assert record["kernels"] == scene.count and record["options"]["iterations"] == 40
    assert out.with_suffix(".png").stat().st_size > 1000
    assert "stills left out" in capsys.readouterr().out
    assert main([*command, "--iterations", "20", "--pin", "below z=-9"]) == 2
    assert "holds none of" in capsys.readouterr().err


def test_command_pins_below_the_height_that_the_data_set_states(stills: ImageSet, tmp_path: Path) -> None:
    (tmp_path / "static").mkdir()
    written(stills, tmp_path / "static", write_rgba)
    facts = {"fps": 24, "views": ["a"], "train_views": ["a"], "heldout_views": [], "train_frames": [0, 16]}
    (tmp_path / "dataset.json").write_text(json.dumps({**facts, "pinned_below_z": -0.2}))
    command = ["reconstruct", str(tmp_path), "--kernels", "80", "--iterations", "20", "--video-share", "0"]
    for given, height in (([], -0.2), (["--pin", "below z=0.1"], 0.1)):
        assert main([*command, *given]) == 0
        scene = load_scene(tmp_path / "scene.ply")
        assert torch.equal(scene.pinned, scene.means[:, 2] < height) and scene.pinned.any()


def test_command_refuses_photos_without_masks_and_leaves_some_out(stills: ImageSet, tmp_path: Path, capsys) -> None:
    def without_alpha(path: Path, image: Tensor) -> None:
        assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., :3].flip(-1).numpy()))

    (tmp_path / "bare").mkdir()
    assert main([*written(stills, tmp_path / "bare", without_alpha), "--iterations", "30"]) == 2
    assert "got 40x40 RGB" in capsys.readouterr().err
    command = [*written(stills, tmp_path, write_rgba), "--iterations", "30", "--kernels", "90"]
    assert main([*command, "--leave-out", "12", "--longest", "30"]) == 0
    measured = json.loads((tmp_path / "scene.json").read_text())["measured"]
    assert measured["stills left out"]["images"] == 2 and measured["stills to train on"]["images"] == 22
    assert not list(tmp_path.glob(".*"))
