"""`gausim inspect`: figures, picture, masks, and the way out where nothing is pinned."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from helpers.plain import plain_scene
from plyfile import PlyData

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


@pytest.mark.parametrize("name", ["stiffness", "damping"])
def test_material_as_picture_and_ply(played: SimpleNamespace, tmp_path: Path, capsys, name: str) -> None:
    out = tmp_path / f"{name}.png"
    assert main(["inspect", str(played.run_dir), "--property", name, "--azimuths", "30", "--out", str(out)]) == 0
    told, ply = capsys.readouterr().out, out.with_suffix(".ply")
    assert name in told and f"PLY        {ply}" in told
    image = cv2.imread(str(out))
    assert image is not None and image.shape[1] > 400
    colored, scene = load_scene(ply), played.module.model.scenes[0]
    free, values = scene.simulated & ~scene.pinned, torch.from_numpy(np.array(PlyData.read(ply)["vertex"][name]))
    assert f"{int(free.sum())} of 36 move" in told and (values[free] > 0).all() and (values[~free] == 0).all()
    assert torch.equal(colored.means, scene.means) and torch.equal(colored.pinned, scene.pinned)
    assert colored.sh_degree == 0 and len(colored.sh[~free].unique(dim=0)) == 1


def test_a_trained_run_tells_what_it_has_learned_and_no_more(toy_run: Path, tmp_path: Path, capsys) -> None:
    asked = ["inspect", str(toy_run), "--out", str(tmp_path / "m.png"), "--property"]
    assert main([*asked, "density"]) == 0
    assert "density over that at the beginning of training" in capsys.readouterr().out
    values = PlyData.read(tmp_path / "m.ply")["vertex"]["density"]
    assert len(np.unique(values[values > 0])) > 1
    assert main([*asked, "stiffness"]) == 2
    assert "has learned density. Take one of these, or a run of model=gausim" in capsys.readouterr().err
