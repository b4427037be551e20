"""The stage that fits a scene: what it records, that it leaves results alone and goes on where it was interrupted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers.plain import cameras_at

from data_prep import reconstruct
from gausim.data.images import write_rgba
from gausim.io.ply import load_scene
from gausim.io.transforms import write_transforms
from gausim.reconstruction.reconstruction import Reconstruction

SIZE, RADIUS = 36, 0.5
OPTIONS = ["--iterations", "40", "--kernels", "60", "--coarse", "0"]


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """A ball, red above and blue below, seen by twelve cameras all around: transforms.json with RGBA pictures."""
    angle = 2 * torch.pi * torch.arange(12) / 12
    away = torch.stack((angle.cos(), angle.sin(), 0.4 * (-1.0) ** torch.arange(12)), -1)
    names = [f"images/{i:02d}.png" for i in range(12)]
    eyes = 2.5 * torch.nn.functional.normalize(away, dim=-1)
    cameras = cameras_at(eyes, (0.0, 0.0, 0.0), focal=50.0, size=SIZE, names=names)
    (tmp_path / "ball" / "images").mkdir(parents=True)
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5 - SIZE / 2, torch.arange(SIZE) + 0.5 - SIZE / 2, indexing="ij")
    inside = (x**2 + y**2).sqrt() < 50 * RADIUS / 2.5
    for name in names:
        image = torch.zeros(SIZE, SIZE, 4, dtype=torch.uint8)
        image[..., 0], image[..., 2], image[..., 3] = 220 * (y < 0), 220 * (y >= 0), 255 * inside
        write_rgba(tmp_path / "ball" / name, image)
    write_transforms(tmp_path / "ball" / "transforms.json", cameras, [{"file_path": name} for name in names])
    return tmp_path / "ball"


def test_it_writes_scene_figures_picture_and_manifest(ball: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ball.parent / "scene"
    assert reconstruct.main([str(ball), "--out", str(out), *OPTIONS, "--pin-below", "z=-0.2"]) == 0
    scene = load_scene(out / "scene.ply")
    manifest = json.loads((out / "stage.json").read_text())
    assert manifest["stage"] == "reconstruct" and manifest["results"]["kernels"] == scene.count
    assert manifest["results"]["pinned"] == int(scene.pinned.sum()) > 0
    assert set(manifest["inputs"]) == {"transforms.json", *(f"images/{i:02d}.png" for i in range(12))}
    assert manifest["results"]["measured"]["stills left out"]["psnr"] > 12
    assert (out / "scene.png").is_file() and not list(out.glob(".*"))
    assert "stills left out" in capsys.readouterr().out
    before = (out / "scene.ply").read_bytes()
    assert reconstruct.main([str(ball), "--out", str(out), *OPTIONS, "--pin-below", "z=-0.2", "--threads", "2"]) == 0
    assert "there already" in capsys.readouterr().out and (out / "scene.ply").read_bytes() == before
    assert reconstruct.main([str(ball), "--out", str(out), *OPTIONS, "--seed", "1"]) == 2
    assert "--force" in capsys.readouterr().err


def test_interrupted_it_goes_on(
    ball: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reconstruct.main([str(ball), "--out", str(ball.parent / "whole"), *OPTIONS]) == 0
    step, made = Reconstruction.step, []

    def failing(self: Reconstruction) -> None:
        if self.done == 20 and not made:
            made.append(self.done)
            raise KeyboardInterrupt
        step(self)

    monkeypatch.setattr(Reconstruction, "step", failing)
    out = ball.parent / "again"
    assert reconstruct.main([str(ball), "--out", str(out), *OPTIONS]) == 130
    assert not out.exists()
    capsys.readouterr()
    assert reconstruct.main([str(ball), "--out", str(out), *OPTIONS]) == 0
    assert "goes on from step " in capsys.readouterr().out
    for name in ("scene.ply", "scene.png"):
        assert (out / name).read_bytes() == (ball.parent / "whole" / name).read_bytes()


def test_a_folder_without_poses_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reconstruct.main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "neither dataset.json nor transforms.json" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
