"""Options are spelled alike, and devices."""

import re
from pathlib import Path

import pytest
import torch
from helpers.plain import random_scene

import gausim
from gausim.cli import evaluate
from gausim.cli import main as cli
from gausim.cli.prepare import STAGES
from gausim.compose import device as home
from gausim.compose.device import find_device
from gausim.core import ConfigError, Rendered, Trajectory
from gausim.ops.orbit import orbit_cameras
from gausim.render.draw import draw_still, film

HYDRA = ("train", "config")
COMMANDS = [[name] for name in cli.COMMANDS if name not in ("prepare", *HYDRA)]
EVERY = [*COMMANDS, *(["prepare", stage] for stage in STAGES)]
# Other words for the same: --objects, --sequences and --cameras of names, --overwrite, --pin, --device, --threads.
WRONG = {
    *("object", "sequence", "camera", "view", "replace", "clobber", "pin-below", "pin-above", "pins", "cuda", "gpu"),
    *("accelerator", "num-threads", "nthreads", "jobs"),
}
PRESENT = {
    "objects": ("evaluate", "simulate", "view", "export"), "sequences": ("evaluate", "simulate", "adapt"),
    "cameras": ("evaluate", "simulate", "export"), "device": ("evaluate", "simulate", "view", "export"),
    "threads": ("evaluate", "simulate", "view", "export", "doctor", "reconstruct"), "overwrite": ("adapt",),
    "pin": ("inspect", "reconstruct", "doctor", "simulate", "view"),
}  # fmt: skip


def shown(argv: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit) as ended:
        cli.command(argv[0])([*argv[1:], "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("argv", EVERY, ids=" ".join)
def test_each_meaning_has_its_spelling(argv: list[str], capsys, monkeypatch) -> None:
    text = shown(argv, capsys, monkeypatch)
    parts = re.split(r"^\s+(?:-\w, )?--(?=[a-z])", text, flags=re.MULTILINE)[1:]
    options = {re.match(r"[a-z-]+", part)[0]: part for part in parts}
    assert not WRONG & set(options), WRONG & set(options)
    assert "force" not in options or "KEY=VALUE" in options["force"]
    for name, commands in PRESENT.items():
        assert name in options or argv[0] not in commands, name
    for name in ("device", "threads"):
        assert argv[0] == "prepare" or name not in options or "default: " in options[name]


@pytest.mark.parametrize(("gpus", "text", "found"), [
    (0, "auto", "cpu"), (0, "cpu", "cpu"), (2, "auto", "cuda"), (2, "cpu", "cpu"), (2, "cuda:1", "cuda:1"),
])  # fmt: skip
def test_the_gpu_is_taken_where_there_is_one(gpus: int, text: str, found: str, monkeypatch) -> None:
    monkeypatch.setattr(home.torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(home.torch.cuda, "device_count", lambda: gpus)
    assert find_device(text) == torch.device(found)
    for wrong in ("gpu", "cuda:x", f"cuda:{gpus}"):
        with pytest.raises(ConfigError, match=f"--device {wrong}: "):
            find_device(wrong)


def test_a_gpu_that_is_not_there_is_one_sentence(monkeypatch, capsys) -> None:
    monkeypatch.setattr(home.torch.cuda, "is_available", lambda: False)
    for argv in (["evaluate", "RUN"], ["simulate", "RUN"], ["view", "RUN"], ["export", "RUN", "--format", "ply"]):
        assert cli.main([*argv, "--device", "cuda"]) == 2
        told = capsys.readouterr().err.strip().splitlines()
        assert len(told) == 1 and "--device cuda: PyTorch sees 0 CUDA devices" in told[0], argv
    with pytest.raises(ConfigError, match="--device cuda"):
        gausim.load("RUN", device="cuda")


def test_all_that_a_renderer_gets_is_on_the_device_of_the_motion() -> None:
    seen: list[torch.Tensor] = []

    def renderer(*inputs, background=None) -> Rendered:
        seen.extend(x for x in (*inputs, background) if isinstance(x, torch.Tensor))
        (width, height), views = inputs[6], inputs[4].shape[:2]
        return Rendered(inputs[0].new_zeros(*views, height, width, 3), inputs[0].new_zeros(*views, height, width))

    scene = random_scene(12, 1)
    cameras, turned = orbit_cameras(scene.means, azimuths=[0.0], size=(8, 6)), torch.eye(3).expand(2, 1, 3, 3)
    units = torch.zeros(12, dtype=torch.long)
    moved = Trajectory(scene.means.expand(2, -1, -1), turned, turned, units, 24.0).to("meta")
    assert film(renderer, scene, moved, cameras, background=torch.ones(3)).device.type == "meta"
    assert {x.device.type for x in seen if x.shape != (3,)} == {"meta"}  # renderers move the background
    seen.clear()
    draw_still(renderer, scene.to("meta"), cameras)
    assert {x.device.type for x in seen} == {"meta"}


@pytest.mark.gpu
def test_a_run_on_the_gpu_is_that_on_the_cpu(toy_run: Path, tmp_path: Path) -> None:
    found = []
    for device in ("cpu", "cuda"):
        sim = gausim.load(toy_run, device=device)
        sim.apply_force("tip", direction="x", weights=2, frames=3)
        sim.step(6)
        found.append((sim.trajectory.to("cpu").positions, sim.render()))
        assert sim.frame.positions.device.type == device
        assert evaluate.main([str(toy_run), "--device", device, "--out", str(tmp_path / device)]) == 0
    torch.testing.assert_close(found[0][0], found[1][0], atol=1e-4, rtol=0)
    assert abs(found[0][1].astype(int) - found[1][1].astype(int)).max() <= 2
