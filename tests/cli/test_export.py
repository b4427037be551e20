"""Every format of `gausim export`, from a run and from a trajectory."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.bodies import NEURAL, make_model
from helpers.played import stand_in
from helpers.toy_object import write_toy_object
from PIL import Image

from gausim.cli import export
from gausim.core import ConfigError
from gausim.core.surroundings import Floor, Surroundings
from gausim.io.ply import load_scene, save_scene
from gausim.io.trajectory import save_trajectory
from gausim.io.video import read_video
from gausim.models.initial_state import ModalInitialStates
from gausim.ops.deformed_scene import deformed_scene
from gausim.render.draw import film

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh", "pinned")


@pytest.fixture
def run(played: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    monkeypatch.chdir(tmp_path)
    return played


def test_ply_files_of_a_run_and_of_a_trajectory_hold_every_frame(run, tmp_path: Path, capsys) -> None:
    scene, whole = run.module.model.scenes[0], run.module.predict(1, 5)
    options = ["--format", "ply", "--sequences", "seq_001", "--frames", "6"]
    assert export.main([str(run.run_dir), *options, "--out", "a"]) == 0
    assert "wrote a: 6 frames of 36 kernels at 24 frames" in capsys.readouterr().out
    save_scene(scene, "rest.ply")
    save_trajectory("toy_seq_001.safetensors", whole)
    stored = ["toy_seq_001.safetensors", "--scene", "rest.ply", "--format", "ply"]
    assert export.main([*stored, "--out", "b"]) == 0
    assert export.main([*stored, "--out", "c", "--every", "2"]) == 0
    expected = [
        deformed_scene(scene, *state, whole.unit_of_kernel)
        for state in zip(whole.positions, whole.deformation_gradients, whole.rotations, strict=True)
    ]
    for folder, every in (("a", 1), ("b", 1), ("c", 2)):
        files = sorted((tmp_path / folder).glob("*.ply"))
        assert json.loads((tmp_path / folder / "toy_seq_001.json").read_text())["fps"] == 24 / every
        for path, made in zip(files, expected[::every], strict=True):
            read = load_scene(path, masks=tmp_path / folder / "toy_seq_001.masks.npz")
            assert all(torch.equal(getattr(read, n), getattr(made, n)) for n in FIELDS)


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


def test_the_page_of_a_motion_begins_at_the_camera(run) -> None:
    assert export.main([str(run.run_dir), "--format", "html", "--frames", "6", "--cameras", "cam_1"]) == 0
    record, page = run.objects[0].sequences[0], Path("toy_seq_000.html").read_text()
    eye = json.loads(page.split('id="settings">')[1].split("<")[0])["camera"]["eye"]
    assert eye == pytest.approx(record.cameras_of(["cam_1"]).centers[0].tolist(), abs=1e-6)


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
    for surroundings in (Surroundings(free=True), Surroundings(floor=Floor((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))):
        run.module.scenes = [replace(toy.scene, surroundings=surroundings)]
        with pytest.raises(ConfigError, match="falls, lies on a floor.*--format html"):
            export.main(command)


def test_the_page_of_a_pure_network_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy = write_toy_object(tmp_path / "toy")
    model = make_model(toy.scene, hidden=32)
    run = stand_in(
        tmp_path / "demo" / "seed_0", toy.root, model=model, initial_states=ModalInitialStates(model, [0, 0])
    )
    monkeypatch.setattr("gausim.compose.build.load_run", lambda path, **_: run)
    with pytest.raises(ConfigError, match="needs a run of model=gausim.*--format html"):
        export.main([str(run.run_dir), "--format", "page"])
