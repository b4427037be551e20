"""A trained toy under a thousand steps of everything, up to the largest force that is allowed."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from helpers.simulators import LEVELS
from msgspec.structs import replace

from gausim.cli import train
from gausim.compose.build import load_run
from gausim.compose.live import ENERGY_ROOM, open_interaction
from gausim.interaction.interaction import Interaction
from gausim.interaction.replay import replay
from gausim.interaction.selections import Ball, Unit, Whole
from gausim.interaction.session import Event, Force, Gravity, Impulse, Pin, Release, Unpin, Wind
from gausim.ops.covariance import covariance_from_scales

TINY = (
    LEVELS, "model.simulator.template.modes=8",
    "model.simulator.network.hidden=8", "data.curriculum.t_max=3", "data.repeats=1", "data.batch_size=2",
    "trainer.max_epochs=4", "trainer.accelerator=cpu", "trainer.progress=false", "trainer.threads=1",
    "render=reference",
    "callbacks.panels=null", "logger=none", "name=toy",
)  # fmt: skip


def random_event(r: random.Random, live: Interaction) -> Event:
    scene = live.scene
    kernel = r.choice((scene.simulated & ~scene.pinned).nonzero()[:, 0].tolist())
    ball = Ball(tuple(scene.means[kernel].tolist()), r.choice([0.1, 0.3]))
    part = r.choice([ball, Unit(1, int(live.units[0][kernel])), Whole()])
    direction = (r.gauss(0, 1), r.gauss(0, 1), r.gauss(0, 1))
    size = live.most_force * r.choice([1.0, r.random()])
    kinds = {
        "force": Force(part, direction, size, frames=r.choice([1, 6, 40]), name=str(r.randrange(3))),
        "impulse": Impulse(part, direction, size / live.fps * (1 - 1e-9)),
        "wind": Wind(direction, r.choice([0.0, size]), gusts=r.random()),
        "gravity": Gravity(direction, r.choice([0.0, size])),
        "pin": Pin(ball), "unpin": Unpin(), "release": Release(),
    }  # fmt: skip
    return kinds[r.choice([*kinds, "force", "force"])]


@pytest.mark.slow
def test_a_thousand_steps_of_random_forces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    root = toy_object.write_toy_object(tmp_path / "data" / "toy").root
    assert train.main([f"data.root={root}", *TINY]) == 0
    run = load_run("outputs/toy/seed_0")
    live = open_interaction(run, keep=None)
    scene, r = live.scene, random.Random(0)
    held = scene.pinned | ~scene.simulated
    rest = covariance_from_scales(scene.log_scales.double(), scene.quats.double())
    for _ in range(1000):
        for _ in range(r.choice([0, 0, 1, 2])):
            live.act(random_event(r, live))
        before, pinned = live.frame.positions, live.held.clone()
        frame = live.step()
        assert torch.isfinite(frame.positions).all() and torch.isfinite(frame.rotations).all()
        gradient = frame.deformation_gradients.double()[live.unit_of_kernel]
        assert float(torch.linalg.eigvalsh(gradient @ rest @ gradient.mT).min()) > 0
        assert torch.equal(frame.positions[held], scene.means[held])
        assert torch.equal(frame.positions[pinned], before[pinned])
    recorded, session = live.trajectory(), live.session()
    assert len(session.entries) > 500
    moved = (recorded.positions - scene.means).norm(dim=-1).amax(1) / scene.diagonal
    assert 0.02 < float(moved.max()) < 2
    start = replace(session, steps=100, entries=tuple(e for e in session.entries if e.at < 100))
    again = replay(open_interaction(load_run("outputs/toy/seed_0")), start)
    assert torch.equal(again.positions, recorded.positions[:101])
    assert torch.equal(again.deformation_gradients, recorded.deformation_gradients[:101])
    ceiling = live._dynamics.energy_ceiling
    assert ceiling is not None and ceiling > 0 and ENERGY_ROOM > 1
