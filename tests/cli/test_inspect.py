"""`gausim inspect`: figures, picture, masks, and the way out where nothing is pinned."""

from pathlib import Path

import cv2
import pytest
import torch
from helpers.plain import plain_scene

from gausim.cli import inspect as command
from gausim.cli.main import main
from gausim.compose.config import compose
from gausim.io.ply import load_scene, save_scene


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    axis = [torch.linspace(0, 1, 4), torch.linspace(0, 1, 3), torch.linspace(0, 2, 5)]
    means = torch.stack(torch.meshgrid(*axis, indexing="ij"), -1).reshape(-1, 3)
    save_scene(plain_scene(means, log_scale=-2.0, sh=torch.zeros(len(means), 4, 3)), tmp_path / "block.ply")
    return tmp_path / "block.ply"


def inspect(scene_file: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["inspect", str(scene_file), "--out", str(scene_file.parent / "clusters.png"), *options]) == 0
    return capsys.readouterr().out


def test_figures_picture_and_masks(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = inspect(scene_file, capsys, "--pin", "below z=0.1", "--radii", "0.3", "0.7", "--save-masks")
    lines = {line.split()[0]: line for line in text.splitlines() if line}
    assert lines["kernels"].split() == ["kernels", "60"] and lines["SH"].split()[-1] == "1"
    assert "z 0 .. 2" in lines["box"] and "pinned 12" in text
    counts = [int(part) for part in lines["levels"].split()[1:] if part.isdigit()]
    assert counts[0] == 60 and 60 > counts[1] > counts[2] >= 2
    for level in ("0", "1", "2"):
        assert float(lines[level].split()[-1]) == pytest.approx(60.0, rel=1e-6)  # mass sum, level by level
    free = [int(lines[level].split()[2]) for level in ("1", "2")]
    assert f"{sum(free)} / 60" in lines["N_F"]
    image = cv2.imread(str(scene_file.parent / "clusters.png"))
    assert image is not None and image.shape[0] > 500
    assert (image.max(-1) > image.min(-1)).any()  # units in colours, not grey only
    assert torch.equal(load_scene(scene_file).pinned, load_scene(scene_file).means[:, 2] < 0.1)


def test_the_default_hierarchy_is_that_of_the_model() -> None:
    levels = compose(["model=gausim"]).model.simulator.hierarchy.levels
    assert tuple(level.diameter for level in reversed(levels)) == command.DEFAULT_RADII
