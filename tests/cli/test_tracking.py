"""Dashboards as `gausim train` uses them: names from the sweep, and no trace in what is learned."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.joint_runs import PAPER, weights
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gausim.cli import train as command
from gausim.io.video import read_video
from gausim.training.callbacks import panels
from gausim.training.module import GausSimModule

TINY = [word for word in PAPER if not word.startswith(("trainer.panel_epochs", "logger"))]
SHOWN = "trainer.panel_epochs=1"


@pytest.fixture
def arguments(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return [f"data.root={toy}", *TINY, "trainer.log_every_n_steps=1"]


def test_panels_see_training_frames_only_and_do_not_change_what_is_learned(arguments, monkeypatch) -> None:
    step, clip = GausSimModule.training_step, panels._clip

    def careless_step(self: GausSimModule, *args: object) -> None:
        step(self, *args)  # type: ignore[arg-type]
        with torch.no_grad():
            self.simulator.parameter_groups()["network"][0].add_(1e-3 * torch.rand(()))

    def careless_clip(*args: object) -> object:
        np.random.rand(), torch.rand(7)
        return clip(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(GausSimModule, "training_step", careless_step)
    monkeypatch.setattr(panels, "_clip", careless_clip)
    command.main([*arguments, SHOWN])
    command.main([*arguments, "name=hidden", "logger=none", "trainer.panel_epochs=0"])
    run = Path("outputs/toy/seed_0")
    hidden = weights(Path("outputs/hidden/seed_0"))
    assert all(torch.equal(value, hidden[name]) for name, value in weights(run).items())

    events = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [e.step for e in events.Images("toy_seq_000/video")] == [1, 2]
    assert {"objects/toy/l2", "objects/toy/ratio_static", "train/grad_network"} <= set(events.Tags()["scalars"])
    assert {path.name for path in (run / "panels" / "step_000002").iterdir()} == {"toy_seq_000.mp4", "toy_seq_000.png"}
    assert len(list(read_video(run / "panels" / "step_000002" / "toy_seq_000.mp4"))) == 3  # frames 0..t_max


def test_a_panel_that_cannot_be_drawn_is_left_out(arguments, monkeypatch, capsys) -> None:
    def explode(self: GausSimModule, sample: object) -> torch.Tensor:
        return torch.full((3, 1, 32, 32, 3), torch.nan)

    monkeypatch.setattr(GausSimModule, "predict_images", explode)
    assert command.main([*arguments, SHOWN, "logger=none", "plan.epochs=1"]) == 0
    assert "no panel of toy at step 1: the predicted images are not finite" in capsys.readouterr().out
    assert list(Path("outputs/toy/seed_0/panels").glob("step_*")) == []
