"""Every format of `gausim export`, from a run and back from its files."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.bodies import NEURAL, make_model
from helpers.glb_files import GlbFile
from helpers.played import stand_in
from helpers.toy_object import write_toy_object
from PIL import Image

from gausim.cli import export
from gausim.core import ConfigError
from gausim.core.surroundings import Surroundings
from gausim.io.ply import save_scene
from gausim.io.ply_sequence import load_ply_sequence
from gausim.io.trajectory import load_trajectory
from gausim.io.video import read_video
from gausim.models.initial_state import ModalInitialStates
from gausim.ops.deformed_scene import deformed_scene
from gausim.render.draw import film

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh", "pinned")


@pytest.fixture
def run(played: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    monkeypatch.chdir(tmp_path)
    return played


def test_a_trajectory_and_ply_files_come_back_bit_for_bit(run, tmp_path: Path, capsys) -> None:
    scene, source = run.module.model.scenes[0], str(run.run_dir)
    options = ["--sequences", "seq_001", "--frames", "6"]
    assert export.main([source, "--format", "safetensors", *options]) == 0
    assert "wrote toy_seq_001.safetensors: 6 frames of 36 kernels at 24 frames" in capsys.readouterr().out
    trajectory, whole = load_trajectory("toy_seq_001.safetensors"), run.module.predict(1, 5)
    for name in ("positions", "deformation_gradients", "rotations", "unit_of_kernel"):
        assert torch.equal(getattr(trajectory, name), getattr(whole, name))

    assert export.main([source, "--format", "ply", "--out", "a", *options]) == 0
    save_scene(scene, "rest.ply")
    stored = ["toy_seq_001.safetensors", "--scene", "rest.ply"]
    assert export.main([*stored, "--format", "ply", "--out", "b"]) == 0
    expected = [
        deformed_scene(scene, *state, whole.unit_of_kernel)
        for state in zip(whole.positions, whole.deformation_gradients, whole.rotations, strict=True)
    ]
    for folder in ("a", "b"):
        scenes, count, fps = load_ply_sequence(folder)
        assert count == 6 and fps == 24.0
        for read, made in zip(scenes, expected, strict=True):
            assert all(torch.equal(getattr(read, n), getattr(made, n)) for n in FIELDS)
    assert (tmp_path / "a" / "toy_seq_001_0006.ply").is_file()
    assert export.main(["a", "--format", "ply", "--out", "c", "--every", "2"]) == 0
    scenes, count, fps = load_ply_sequence("c")
    assert count == 3 and fps == 12.0 and [torch.equal(s.means, expected[2 * i].means) for i, s in enumerate(scenes)]


def test_frames_without_units_make_no_trajectory(run) -> None:
    assert export.main([str(run.run_dir), "--format", "ply", "--frames", "2", "--out", "p"]) == 0
    for form in ("safetensors", "motion", "html"):
        with pytest.raises(ConfigError, match=f"--format {form}: p holds frames without units"):
            export.main(["p", "--format", form])


def test_usd(run) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core (extra usd)")
    assert export.main([str(run.run_dir), "--format", "usd", "--frames", "4", "--out", "m.usdc"]) == 0
    stage = usd.Stage.Open("m.usdc")
    positions = stage.GetDefaultPrim().GetAttribute("positions")
    assert torch.equal(torch.tensor(positions.Get(2)), run.module.predict(0, 3).positions[2])


def test_pictures(run) -> None:
    source, short = str(run.run_dir), ["--frames", "2"]
    assert export.main([source, "--format", "mp4", *short, "--cameras", "cam_1", "--out", "v.mp4"]) == 0
    shown = list(read_video("v.mp4"))
    assert len(shown) == 2 and shown[0].shape == (32, 32, 3) and shown[0].max() > 60
    # A trajectory's frames are drawn as the run draws them: deformed scenes are the same Gaussians.
    whole, record = run.module.predict(0, 1), run.objects[0].sequences[0]
    expected = film(run.renderer, run.module.model.scenes[0], whole, record.cameras_of(["cam_1"]))[:, 0].numpy()
    assert abs(shown[1].astype(int) - expected[1].astype(int)).mean() < 3
    options = ["--size", "40", "--background", "white", "--azimuth", "90"]
    assert export.main([source, "--format", "gif", *short, "--out", "v.gif", *options]) == 0
    with Image.open("v.gif") as image:
        assert image.n_frames == 2 and image.size == (40, 40) and min(image.convert("RGB").getpixel((0, 0))) > 245


def test_a_compact_motion_and_its_page(run, capsys) -> None:
    source = str(run.run_dir)
    assert export.main([source, "--format", "motion", "--frames", "6", "--every", "2"]) == 0
    assert "wrote toy_seq_000.motion.glb: 3 frames of 36 kernels at 12 frames" in capsys.readouterr().out
    GlbFile(Path("toy_seq_000.motion.glb")).check_splats(run.module.model.scenes[0], degree=0)
    assert export.main([source, "--format", "html", "--frames", "6", "--cameras", "cam_1"]) == 0
    record, page = run.objects[0].sequences[0], Path("toy_seq_000.html").read_text()
    eye = json.loads(page.split('id="settings">')[1].split("<")[0])["camera"]["eye"]
    assert eye == pytest.approx(record.cameras_of(["cam_1"]).centers[0].tolist(), abs=1e-6)


def test_frames_as_gltf(run) -> None:
    assert export.main([str(run.run_dir), "--format", "gltf", "--frames", "4", "--every", "2", "--out", "g"]) == 0
    assert sorted(path.name for path in Path("g").iterdir()) == [f"toy_seq_000_000{i}.glb" for i in (1, 2)]
    found = GlbFile(Path("g/toy_seq_000_0002.glb")).attribute("POSITION")
    assert torch.equal(found, run.module.predict(0, 3).positions[2])


def test_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    toy = write_toy_object(tmp_path / "toy")
    model = make_model(toy.scene, **NEURAL)
    states = ModalInitialStates(model, [0, 0])
    run = stand_in(tmp_path / "demo" / "seed_0", toy.root, model=model, initial_states=states)
    monkeypatch.setattr("gausim.compose.build.load_run", lambda path, **_: run)
    command = [str(run.run_dir), "--format", "page", "--out", str(tmp_path / "p.html")]
    assert export.main(command) == 0
    said = capsys.readouterr().out
    assert "36 kernels" in said and "without the network, which would move a kernel by" in said
    page = (tmp_path / "p.html").read_text(encoding="utf-8")
    settings = json.loads(page.split('id="settings">')[1].split("</script>")[0])
    assert [start["name"] for start in settings["starts"]] == ["seq_000", "seq_001"]
    assert settings["starts"][0]["frames"] > settings["starts"][0]["seen"] > 0 and settings["ceiling"] > 0
    about = dict(settings["about"])
    assert len(about["Data (SHA-256)"]) > 64 and "commit" in about["Made by"] and "Apache" in about["Licence"]
    run.module.scenes = [replace(toy.scene, surroundings=Surroundings(free=True))]
    with pytest.raises(ConfigError, match="falls.*--format html"):
        export.main(command)
