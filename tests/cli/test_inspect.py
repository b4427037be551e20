"""`gausim inspect`: figures, picture, masks, and the way out where nothing is pinned."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
import torch

from gausim.cli.main import main
from gausim.compose.config import compose
from gausim.compose.places import more_settings
from gausim.core.scene import GaussianScene
from gausim.io.ply import load_scene, masks_path, save_scene


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


def lines_of(text: str) -> dict[str, str]:
    return {line.split()[0]: line for line in text.splitlines() if line}


def test_figures_picture_and_masks(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = scene_file.parent / "clusters.png"
    arguments = ["inspect", str(scene_file), "--pin-below", "z=0.1", "--radii", "0.3", "0.7", "--save-masks"]
    assert main([*arguments, "--out", str(picture)]) == 0
    text = capsys.readouterr().out
    lines = lines_of(text)
    assert lines["kernels"].split() == ["kernels", "60"]
    assert lines["SH"].split()[-1] == "1"
    assert "z 0 .. 2" in lines["box"]
    assert lines["masks"].startswith("masks      ") and "pinned 12" in text
    counts = [int(part) for part in lines["levels"].split()[1:] if part.isdigit()]
    assert counts[0] == 60 and 60 > counts[1] > counts[2] >= 2
    for level in ("0", "1", "2"):
        assert float(lines[level].split()[-1]) == pytest.approx(60.0, rel=1e-6)  # mass sum, level by level
    free = [int(lines[level].split()[2]) for level in ("1", "2")]
    assert f"{sum(free)} / 60" in lines["N_F"]
    image = cv2.imread(str(picture))
    assert image is not None and image.shape[0] > 500
    assert (image.max(-1) > image.min(-1)).any()  # units in colours, not grey only
    assert masks_path(scene_file).is_file()
    assert torch.equal(load_scene(scene_file).pinned, load_scene(scene_file).means[:, 2] < 0.1)


def test_up_points_away_from_the_pins_unless_given(scene_file: Path) -> None:
    pictures = [scene_file.parent / f"{i}.png" for i in range(3)]
    for picture, more in zip(pictures, ([], ["--up=-z"], ["--up=z"]), strict=True):
        assert main(["inspect", str(scene_file), "--pin-above", "z=1.9", *more, "--out", str(picture)]) == 0
    first, second, third = (picture.read_bytes() for picture in pictures)
    assert first == second != third


def test_simulated_half(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["inspect", str(scene_file), "--simulate-below", "x=0.5", "--pin-below", "z=0.1", "--radii", "0.5"]
    assert main([*arguments, "--out", str(scene_file.parent / "half.png")]) == 0
    text = capsys.readouterr().out
    assert "simulated 30  pinned 6" in text


def test_scene_without_pins_says_how_to_mark_one(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(scene_file)]) == 2
    error = capsys.readouterr().err
    assert "no kernel is pinned" in error and "--pin-below z=0.2" in error and "--save-masks" in error


@pytest.mark.parametrize(
    ("arguments", "needle"),
    [
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


def test_missing_scene_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(tmp_path / "absent.ply")]) == 2
    assert "absent.ply: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["gausim", "gausim_paper"])
def test_the_default_hierarchy_is_that_of_the_models(
    option: str, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    simulator = compose("train", [f"model={option}"]).model.simulator
    common = ["inspect", str(scene_file), "--pin-below", "z=0.1", "--out", str(scene_file.parent / "clusters.png")]
    assert main(common) == 0
    default = capsys.readouterr().out
    hierarchy = simulator.hierarchy
    clustering = more_settings()["model.simulator.hierarchy.clustering"]
    radii = [str(level.diameter) for level in reversed(hierarchy.levels)]
    assert main([*common, "--clustering", clustering, "--radii", *radii]) == 0
    assert capsys.readouterr().out == default
    assert all(f"{float(radius):.3g} of diagonal" in default for radius in radii)


def test_help_says_what_radii_are_fractions_of(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["inspect", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "fractions of the diagonal" in text and "0.13 0.4" in text
