"""`gausim inspect`: figures, picture, masks, and the way out where nothing is pinned."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
import torch

from gausim.cli import inspect as command
from gausim.cli.main import main
from gausim.compose.config import compose
from gausim.compose.places import more_settings
from gausim.core.scene import GaussianScene
from gausim.io.ply import load_scene, save_scene
from gausim.report.pictures import clusters


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    axis = [torch.linspace(0, 1, 4), torch.linspace(0, 1, 3), torch.linspace(0, 2, 5)]
    means = torch.stack(torch.meshgrid(*axis, indexing="ij"), -1).reshape(-1, 3)
    count = len(means)
    scene = GaussianScene.create(
        means=means,
        log_scales=torch.full((count, 3), -2.0),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 4, 3),
    )
    save_scene(scene, tmp_path / "block.ply")
    return tmp_path / "block.ply"


def inspect(scene_file: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["inspect", str(scene_file), "--out", str(scene_file.parent / "clusters.png"), *options]) == 0
    return capsys.readouterr().out


def test_figures_picture_and_masks(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = inspect(scene_file, capsys, "--pin-below", "z=0.1", "--radii", "0.3", "0.7", "--save-masks")
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


@pytest.mark.parametrize(("more", "down"), [([], True), (["--up=-z"], True), (["--up=z"], False)])
def test_up_points_away_from_the_pins_unless_given(scene_file: Path, monkeypatch, more: list[str], down: bool) -> None:
    drawn: list[bool] = []
    monkeypatch.setattr(clusters, "draw_clusters", lambda *_, flip, **__: drawn.append(flip))
    assert main(["inspect", str(scene_file), "--pin-above", "z=1.9", *more]) == 0
    assert drawn == [down]


def test_simulated_half(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--simulate-below", "x=0.5", "--pin-below", "z=0.1", "--radii", "0.5"]
    assert "simulated 30  pinned 6" in inspect(scene_file, capsys, *options)


@pytest.mark.parametrize(
    ("arguments", "needle"),
    [
        ([], "no kernel is pinned"),
        (["--pin-below", "z=-5"], "holds none of 60 kernels"),
        (["--pin-below", "height=3"], "AXIS=VALUE"),
        (["--pin-below", "z=0.1", "--radii", "40"], "--radii"),
        (["--masks", "absent.npz"], "absent.npz: no such file"),
    ],
)
def test_wrong_options_are_explained(
    scene_file: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], needle: str
) -> None:
    assert main(["inspect", str(scene_file), *arguments]) == 2
    assert needle in capsys.readouterr().err


@pytest.mark.parametrize("option", ["gausim", "gausim_paper"])
def test_the_default_hierarchy_is_that_of_the_models(option: str) -> None:
    levels = compose("train", [f"model={option}"]).model.simulator.hierarchy.levels
    assert tuple(level.diameter for level in reversed(levels)) == command.DEFAULT_RADII
    assert more_settings()["model.simulator.hierarchy.clustering"] == command.DEFAULT_CLUSTERING
