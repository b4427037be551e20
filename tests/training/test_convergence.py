"""When training ends, what it says then, and what more time goes on from."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from helpers.simulators import SMALLEST, silence
from helpers.toy_runs import Trainings
from helpers.toy_runs import rows as rows_of

from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.core import RunError
from gausim.runs.checkpoint import read_checkpoint
from gausim.training.callbacks.convergence import Convergence, forecast, verdict
from gausim.training.rollout import States

TINY = (
    *SMALLEST, "model=gausim_paper", "data.curriculum.t_max=3", "data.repeats=2", "trainer.accelerator=cpu",
    "trainer.convergence.held_back=1", "trainer.convergence.window=4", "render=cpu", "callbacks.motion=null",
    "logger=none", "evaluate=false",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def train(toy: Path, name: str, *overrides: str) -> Path:
    assert command.main([*TINY, f"data.root={toy}", f"name={name}", *overrides]) == 0
    return Path(f"outputs/{name}/seed_0")


def judged(errors: list[float], shows: int, **settings: float) -> Convergence:
    made = Convergence(**settings)  # type: ignore[arg-type]
    made.load_state_dict({"forecasts": [[e, 0.5] for e in errors], "converged": False, "ending_since": None,
                          "allowance": 1})  # fmt: skip
    made._shows = shows
    return made


def test_improvement_is_per_ten_shows_whatever_an_epoch_is() -> None:
    falling = [0.9 ** (shows / 10) for shows in range(0, 80, 4)]  # a tenth in ten shows
    falling[-4:-1] = [1.0, 1.2, 1.0]  # at constant rates the error goes up and down
    assert judged(falling, 4, window=24).improvement == pytest.approx(0.1)
    assert judged(falling[1::2], 8, window=24).improvement == pytest.approx(0.1)
    assert judged(falling[:11], 4, window=24).improvement is None  # two stretches of six epochs are needed
    assert judged([0.5, 0.5, 0.6, 0.6], 4, window=8).improvement == 0.0
    assert judged([0.1, -0.01], 4, window=4).improvement == 0.0  # better than the reconstruction's own floor


def test_a_run_ends_when_it_no_longer_improves_and_then_sees_all_frames(toy: Path) -> None:
    # Nothing is an improvement for this tolerance: the end begins as soon as it can be told.
    settings = ("trainer.convergence.tolerance=0.99", "trainer.max_epochs=40", "optimizer.schedule.decay=0.5")
    run = train(toy, "early", *settings)
    rows = rows_of(run / "epochs.csv")
    told = [float(row["held_back"]) if row["held_back"] else None for row in rows]
    steps = [float(row["steps"]) for row in rows]
    began = len([e for e in told if e is not None])
    assert began == 4  # two stretches of two epochs; T is at its largest from the first on
    assert len(rows) == 8 and told == [*told[:4], None, None, None, None]
    assert steps == [2.0] * 4 + [3.0] * 4  # the frame held back is shown in the end
    rates = [float(row["lr"]) for row in rows]
    assert rates[2] == rates[3] > rates[5] > rates[7]
    facts = json.loads((run / "FINISHED").read_text())
    assert facts["epochs"] == 8 and facts["learning"]["converged"] and not (run / "before_the_end.ckpt").exists()
    with pytest.raises(RunError, match="this run is finished"):
        train(toy, "early", *settings)


def test_a_run_cut_short_goes_on_by_the_same_command_as_if_it_had_had_the_time(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ("trainer.convergence.tolerance=0.0", "trainer.convergence.window=100")
    run = train(toy, "short", *settings, "trainer.max_epochs=3")
    assert "cut short" in (said := capsys.readouterr().out) and "The same command goes on" in said
    assert len(rows_of(run / "epochs.csv")) == 3 and read_checkpoint(run / "before_the_end.ckpt")["epoch"] == 1
    train(toy, "short", *settings, "trainer.max_epochs=3")
    assert len(rows_of(run / "epochs.csv")) == 6 and json.loads((run / "FINISHED").read_text())["learning"]["cut_short"]
    whole = train(toy, "long", *settings, "trainer.max_epochs=6")
    found, expected = (read_checkpoint(path / "last.ckpt")["state_dict"] for path in (run, whole))
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert rows_of(run / "epochs.csv") == rows_of(whole / "epochs.csv")


def test_the_forecast_is_one_for_a_still_object_and_none_for_the_truth(toy_run: Path) -> None:
    run = load_run(toy_run)
    samples = [run.datamodule.training_sample(i, 3) for i in range(2)]
    module = run.module
    for p in module.initial_states.parameters():
        p.data.zero_()
    silence(module.model)  # nothing moves a body at rest
    still = forecast(module, samples, 2)
    assert still.error == pytest.approx(1.0, abs=1e-3) and 0.1 < still.moving < 1.0
    frames = [s.frames for s in samples]
    for sample, own in zip(samples, frames, strict=True):
        object.__setattr__(sample, "frames", own[:1].expand_as(own))
    module.baselines._known.clear()
    assert forecast(module, samples, 2).moving == pytest.approx(0.0, abs=1e-6)


def test_the_forecast_moves_what_a_hand_holds(trainings: Trainings, monkeypatch: pytest.MonkeyPatch) -> None:
    run = load_run(
        trainings.whole("held_briefly", trainings.moving("held"), "model=gausim_paper", "trainer.max_epochs=1")
    )
    module, sample, seen = run.module, run.datamodule.training_sample(0, 3), list[torch.Tensor]()

    def compare(states: States, start: int) -> tuple[torch.Tensor, torch.Tensor]:
        seen.append(states.positions)
        return torch.zeros(len(states.positions), 1), torch.zeros(())

    monkeypatch.setattr(module.supervision, "comparison", lambda samples, batch: compare)
    forecast(module, [sample], 2)
    scene = module.simulator.scenes[0]
    held = scene.pinned & (scene.hand == 0)
    moved = seen[0][-1] - scene.means
    way = 3 * 0.03 * torch.tensor([1.0, 0.0, 0.5])  # of the hand in three frames
    torch.testing.assert_close(moved[held], way.expand(int(held.sum()), 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("error", "moving", "rate", "converged", "said"),
    [
        (0.3, 0.9, 0.002, True, "It has learned: on frames held back it leaves 30% of what a still object misses"),
        (0.95, 0.9, 0.0, True, "hardly foresees.*gausim doctor"),
        (0.4, 0.9, 0.031, False, "still improving 3.1% per 10 shows.*The same command goes on"),
        (0.4, 0.9, -0.01, False, "no longer improving"),
        (0.4, 0.9, None, False, "cut short before it could be told.*The same command goes on"),
        (1.0, 0.01, 0.0, True, "hardly anything to learn.*1%.*gausim doctor"),
        (None, None, None, False, "cut short before it could be judged"),
    ],
)
def test_the_verdict(error: float | None, moving: float | None, rate: float | None, converged: bool, said: str) -> None:
    found = {"held_back_error": error, "moving": moving, "improvement": rate, "converged": converged}
    assert re.search(said, verdict(found)), verdict(found)


@pytest.mark.parametrize(
    "override", ["optimizer=paper", pytest.param("optimizer.schedule.decay=1", marks=pytest.mark.slow)]
)
def test_what_cannot_be_judged_has_its_epochs_and_frames(toy: Path, override: str) -> None:
    run = train(toy, "unjudged", override, "trainer.max_epochs=2")
    rows = rows_of(run / "epochs.csv")
    assert [float(row["steps"]) for row in rows] == [2.0, 3.0] and not any(row["held_back"] for row in rows)
    assert "learning" not in json.loads((run / "FINISHED").read_text())
