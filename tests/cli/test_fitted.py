"""Fitted methods through the same commands as the simulator: train, evaluate, report, simulate; resume; messages."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.toy_object import write_toy_object
from helpers.toy_runs import rows

from gausim.baselines.fitting import Fit
from gausim.cli import evaluate, report, simulate, train
from gausim.compose.build import load_run
from gausim.core import ConfigError
from gausim.results.table import load_results
from gausim.runs.checkpoint import read_checkpoint

TINY = (
    "plan.t_max=3", "trainer.accelerator=cpu", "trainer.progress=false", "trainer.threads=1",
    "render=cpu", "trainer.panel_epochs=0", "name=toy", "doctor=false",
)  # fmt: skip
STAGES = "model.plan.stages"
SMALL: dict[str, list[str]] = {
    "static": [],
    "spring_mass": [
        "model.method.anchors=12", "model.method.neighbours=8", "model.method.substeps=10", "model.plan.round=2",
        f"{STAGES}.velocity.iterations=4", f"{STAGES}.dynamics.iterations=2",
    ],
    "deformation_field": [
        "model.method.resolution=4", "model.method.features=4", "model.method.hidden=8",
        f"{STAGES}.field.iterations=4", "model.plan.round=2",
    ],
    "physdreamer": [
        "model.method.particles=30", "model.method.discretisation.cells=12", f"{STAGES}.velocity.iterations=4",
        f"{STAGES}.material.iterations=2", "model.plan.round=2",
    ],
    "physgaussian": ["model.method.discretisation.cells=12", f"{STAGES}.velocity.iterations=4", "model.plan.round=2"],
}  # fmt: skip
# The material point method needs warp-lang (extra 'baselines'); one method stands for all in the default tests.
METHODS = [pytest.param(name, marks=[pytest.mark.slow] * (name != "spring_mass")) for name in SMALL]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shorter than that of the session: every method is evaluated."""
    return write_toy_object(tmp_path_factory.mktemp("data") / "toy", frames=9).root


@pytest.fixture
def arguments(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return [f"data.root={toy}", *TINY]


@pytest.mark.parametrize("model", METHODS)
def test_the_same_commands_serve_every_method(model: str, arguments: list[str]) -> None:
    if model.startswith("phys"):
        pytest.importorskip("warp")
    assert train.main([f"model={model}", *SMALL[model], *arguments]) == 0
    run = Path("outputs/toy/seed_0")
    assert evaluate.main([str(run)]) == 0
    results = load_results(run / "evaluation" / "metrics.json")
    (row,) = results.objects["toy"].methods
    notes = results.objects["toy"].notes[row]
    assert row.startswith(model) and row in {e.row for e in results.table} and notes
    assert all(note in (run / "evaluation" / "table.md").read_text() for note in notes)
    assert simulate.main([str(run), "--frames", "12", "--cameras", "cam_0"]) == 0
    assert report.main([str(run), "--out", "page", "--no-pictures"]) == 0
    written = "".join(p.read_text() for p in Path("page").iterdir() if p.suffix == ".md").replace("\\", "")
    assert model in written and ("Does not extrapolate" in written) == (model == "deformation_field")
    assert all(note in written for note in load_run(run).module.notes())  # type: ignore[operator]


def weights(run: str) -> dict[str, torch.Tensor]:
    return read_checkpoint(Path(f"outputs/{run}/seed_0/last.ckpt"))["state_dict"]


def test_stages_set_frames_and_what_learns(arguments: list[str]) -> None:
    still = f"~{STAGES}.dynamics.rates.velocity"
    train.main(["model=spring_mass", *SMALL["spring_mass"], still, *arguments])
    epochs = rows(Path("outputs/toy/seed_0/epochs.csv"))
    assert [float(r["steps"]) for r in epochs] == [3.0, 3.0, 3.0]  # the velocity stage asks for three frames as well
    made = weights("toy")
    moved = {name: bool(value.abs().max() > 0) for name, value in made.items() if "velocity" in name}
    assert len(moved) == 2 and all(moved.values())
    assert float(made["model.stiffness.0"].std()) > 1e-4 and float(made["model.damping.0"]) != -1.0
    train.main(["model=spring_mass", *SMALL["spring_mass"], f"{STAGES}.dynamics=null", *arguments, "name=short"])
    short = weights("short")
    assert float(short["model.stiffness.0"].std()) < 1e-6  # all alike
    assert torch.equal(short["model.velocity.1"], made["model.velocity.1"])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["spring_mass", "deformation_field", "physdreamer"])
def test_a_resumed_fit_equals_an_uninterrupted_one(model, arguments, monkeypatch) -> None:
    if model.startswith("phys"):
        pytest.importorskip("warp")
    asked = [f"model={model}", *SMALL[model], *arguments]
    monkeypatch.setattr("gausim.baselines.fitting.SAVED_AFTER", -1.0)  # after every step
    train.main([*asked, "name=whole"])
    step, calls = Fit._step, []

    def crash(self: Fit, *args: Any) -> None:
        if len(calls) == 6:  # within the second epoch of four steps
            raise MemoryError("power cut")
        calls.append(1)
        step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Fit, "_step", crash)
        with pytest.raises(MemoryError):
            train.main([*asked, "name=cut"])
    train.main([*asked, "name=cut"])
    whole, cut = weights("whole"), weights("cut")
    for name, value in whole.items():
        torch.testing.assert_close(cut[name], value, rtol=0, atol=0, msg=name)
    notes = [load_run(Path(f"outputs/{run}/seed_0")).module.notes() for run in ("whole", "cut")]  # type: ignore[operator]
    assert notes[0][:-1] == notes[1][:-1] and not any(" had " in note for note in notes[0])
    assert re.fullmatch(r"Trained in .* minutes, .* of processor time.*", notes[0][-1])
    tables = [rows(Path(f"outputs/{run}/seed_0/epochs.csv")) for run in ("whole", "cut")]
    assert len(tables[0]) > 1 and tables[0] == tables[1]


def test_a_budget_walks_through_all_stages_and_says_what_was_cut(arguments, monkeypatch) -> None:
    clock = iter(float(i) for i in range(10_000))  # every look at the clock takes a second
    monkeypatch.setattr("time.process_time", lambda: next(clock))
    long = [f"{STAGES}.velocity.iterations=40", f"{STAGES}.dynamics.iterations=40"]
    budget = ["plan.max_minutes=0.3", "plan.clock=cpu"]
    train.main(["model=spring_mass", *SMALL["spring_mass"], *long, *budget, *arguments])
    notes = load_run(Path("outputs/toy/seed_0")).module.notes()  # type: ignore[operator]
    cut = [note for note in notes if " had " in note and "iterations per sequence" in note]
    assert any("is of 40 iterations per sequence; the original takes 100" in note for note in notes)
    assert len(cut) == 2 and all("0 of its" not in note for note in cut)
    assert json.loads(Path("outputs/toy/seed_0/FINISHED").read_text())["notes"] == notes


def test_without_warp_one_line_says_what_to_install(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)  # importing it fails as if it were not installed
    with pytest.raises(ConfigError, match=r"^[^\n]*pip install 'gausim\[baselines\]'[^\n]*$"):
        train.main(["model=physdreamer", *SMALL["physdreamer"], *arguments])
