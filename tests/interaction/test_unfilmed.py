"""Scenes that were never filmed, moved by the shared weights of a run and a chosen material."""

from pathlib import Path

import pytest
import torch
from helpers.plain import plain_scene
from helpers.simulators import SMALLEST

from gausim.cli import train
from gausim.compose.unfilmed import open_scene
from gausim.core import ConfigError
from gausim.interaction.replay import replay
from gausim.interaction.selections import Whole
from gausim.interaction.session import Force, Material


def test_a_scene_that_was_never_filmed_swings_as_its_stiffness_says(toy: Path, tmp_path: Path) -> None:
    small = ["model.simulator.template.modes=12", "model.simulator.template.solid.spacing=0.2", "plan.epochs=1"]
    quick = ["plan.t_max=3", "trainer=cpu"]
    base = tmp_path / "base"
    assert train.main([f"data.root={toy}", *SMALLEST, *small, *quick, f"hydra.run.dir={base}"]) == 0
    steps = torch.arange(9.0) / 8
    means = torch.cartesian_prod(steps[:3], steps[:3], steps)
    body = plain_scene(means, pinned=means[:, 2] == 0, name="beam")
    periods = {}
    for stiffness in (1.0, 4.0):
        live = open_scene(body, fps=24.0, base=base, stiffness=stiffness, damping=0.1, sway=0.02)
        tip = [float(live.step().positions[8, 0]) for _ in range(25 // int(stiffness**0.5))]
        periods[stiffness] = 4 * (1 + tip.index(max(tip)))  # frames to the first turn
    assert periods[1.0] == pytest.approx(24, abs=6) and periods[4.0] == pytest.approx(12, abs=3)

    live = open_scene(body, fps=24.0, base=base)
    live.act(Force(Whole(), (1.0, 0.0, 0.0), 0.02))
    amplitudes = {}
    for stiffness in (1.0, 0.25, 4.0):
        live.act(Material(stiffness, damping=10.0))
        amplitudes[stiffness] = float([live.step() for _ in range(48)][-1].positions[8, 0] - body.means[8, 0])
    assert amplitudes[0.25] == pytest.approx(4 * amplitudes[1.0], rel=0.2)  # bends as a spring does
    assert amplitudes[4.0] == pytest.approx(amplitudes[1.0] / 4, rel=0.2)
    last = live.frame.positions
    again = open_scene(body, fps=24.0, base=base)
    assert torch.equal(replay(again, live.session()).positions[-1], last)
    assert torch.equal(replay(live, live.session()).positions[-1], last)  # which begins with the first material
    alone = [open_scene(body, fps=24.0, stiffness=given, sway=0.02) for given in (None, 4.0)]
    assert not torch.equal(*(live.step().positions for live in alone))  # the template without a network has one, too
    with pytest.raises(ConfigError, match="--stiffness -1: expected a number > 0"):
        open_scene(body, fps=24.0, base=base, stiffness=-1.0)
