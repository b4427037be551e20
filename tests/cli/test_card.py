"""`gausim card` and `gausim report`: pages made from what the directories of runs record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from helpers import report_runs

from gausim.cli import card
from gausim.cli import main as cli
from gausim.core import DataError, RunError

CELL = {"mean": 0.012, "std": 0.001, "ratio": 0.25}


def cells(ratio: float, energy: float) -> dict:
    return {"train": {"l2": {**CELL, "ratio": ratio}, "motion_energy": {"mean": energy, "std": 0, "pooled": energy}}}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run as its files tell it, with an evaluation in images only."""
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    (folder / "evaluation").mkdir()
    (tmp_path / "toy").mkdir()
    facts = {"name": "toy", "licence": "CC-BY-4.0", "simulation": {"method": "a spring"}}
    (tmp_path / "toy" / "dataset.json").write_text(json.dumps(facts))
    config = {"name": "mine", "seed": 7, "data": {"root": str(tmp_path / "toy"), "names": None}, "model": {"x": 1},
              "trainer": {"accelerator": "cpu", "threads": 1, "max_epochs": 3}}  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    choices = {"hydra": {"runtime": {"choices": {"model": "gausim", "trainer": "cpu"}}}}
    (folder / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(choices))
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(["model=gausim", "data.root=/home/me/secret"]))
    (folder / "FINISHED").write_text(json.dumps({"epochs": 3, "optimizer_steps": 12, "last_epoch": {}}))
    entry = {
        "fps": 24.0, "sequences": ["a", "b"], "frames": [20, 30], "views": ["v"], "train_views": ["v"],
        "heldout_views": [], "methods": ["gausim"], "splits": {"seen": [0, 8], "unseen": [8, 20]},
        "metrics": {"l2": {"label": "l2", "scale": 1000.0, "unit": "1e-3", "higher_is_better": False},
                    "motion_energy": {"label": "motion energy", "scale": 1.0, "unit": "", "higher_is_better": None}},
        "floor": {}, "contrast": {"mean_color": [0, 0, 0], "norm": 0, "max_l2": 0},
        "rows": {"gausim": {"seen": cells(0.125, 0.99), "unseen": cells(0.25, 0.75)},
                 "static": {"seen": cells(1, 0), "unseen": cells(1, 0)}},
        "absent": {"lpips": "no weights"},
        "footnotes": {"gausim": {"extrapolates": True, "notes": [], "largest_eigenvalue": 1.25,
                                 "fit": {"seconds": 90.0, "cpu_seconds": 60.0, "peak_bytes": 2e9}}},
        "sources": {"scene": {"file": "scene.ply", "sha256": "ab" * 32}},
    }  # fmt: skip
    summary = {"schema": "gausim.evaluation/1", "run": {"views": "all", "epoch": 2, "updates": 12, "finished": True},
               "provenance": {"gausim": "9.9", "torch": "8.8", "python": "7.7", "commit": "c0ffee", "modified": True},
               "objects": {"toy": entry}}  # fmt: skip
    (folder / "evaluation" / "metrics.json").write_text(json.dumps(summary))
    return folder


def written(run: Path, *options: str) -> str:
    assert card.main([str(run), "--force", *options]) == 0
    return (run / "README.md").read_text()


def section(text: str, title: str) -> str:
    return text.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def test_the_front_matter_and_every_section_say_what_the_run_records(run: Path) -> None:
    text = written(run, "--licence", "MIT")
    head = yaml.safe_load(text.split("---\n")[1])
    assert head["license"] == "mit" and head["library_name"] == "gausim"
    result = head["model-index"][0]["results"][0]
    assert result["dataset"] == {"type": "toy", "name": "toy"}
    assert [(m["type"], m["value"]) for m in result["metrics"]] == [("l2", 12.0), ("l2", 12.0)]
    assert "unseen frames 8..19" in result["metrics"][1]["name"]
    assert "| toy | 2 | 20 to 30 at 24 fps | 0..7 | v | none | CC-BY-4.0 |" in section(text, "Data")
    assert "ab" * 32 in section(text, "Data")
    assert "epoch 2, 12 updates" in section(text, "Figures") and "12.00 ± 1.00 | 0.250" in section(text, "Figures")
    assert "1.5 minutes, 1.0 minutes of processor time, and held 2.00 GB" in section(text, "Training")
    assert "gausim 9.9 (commit `c0ffee`, with changes that are in no commit), torch 8.8" in section(text, "Versions")
    assert "| `trainer.max_epochs` | `3` | `60` |" in section(text, "Configuration")
    assert section(text, "Licence").startswith("\nMIT, for the files of this run")
    assert f"gausim evaluate {run} --data DIR" in section(text, "Loading")
    assert "Missing" not in text
    told = section(text, "Configuration")  # without paths of the machine that trained
    assert "gausim train model=gausim data.root=..." in told and "secret" not in told and "data.root`" not in told


def test_limitations_are_those_of_the_figures(run: Path) -> None:
    said = section(written(run), "Limitations")
    for sentence in (
        "in unseen frames 8..19 its l2 (training views) is 0.25 of what standing still has, in the seen ones 0.12",
        "0.75 of the true motion's energy",
        "true motion in 3D is not known",
        "no view was kept from training",
        "small motions grow (largest eigenvalue 1.2500)",
        "lpips was not computed (no weights)",
        "its videos are computed (a spring), not filmed",
        f"was not measured (`gausim evaluate {run} --endurance 1000`)",
    ):
        assert sentence in said, sentence


def test_what_is_missing_is_named_with_the_command_that_makes_it(run: Path, tmp_path: Path) -> None:
    (run / "evaluation" / "metrics.json").unlink()
    (run / "FINISHED").unlink()
    (tmp_path / "toy").rename(tmp_path / "gone")
    text = written(run)
    assert f"Missing. `gausim evaluate {run}` measures them" in section(text, "Figures")
    assert f"`gausim card {run} --data DIR` reads it elsewhere" in section(text, "Data")
    assert "Not finished" in section(text, "Training") and "not evaluated" in section(text, "Limitations")
    assert f"Missing. `gausim card {run} --licence ID` states it." in section(text, "Licence")
    assert "license" not in yaml.safe_load(text.split("---\n")[1])
    assert "reads it elsewhere" not in written(run, "--data", str(tmp_path / "gone"))
    with pytest.raises(DataError, match="data.root names .*nowhere"):
        card.main([str(run), "--force", "--data", str(tmp_path / "nowhere")])


def test_a_card_that_is_there_is_not_replaced_unasked(run: Path, tmp_path: Path) -> None:
    (run / "README.md").write_text("mine")
    with pytest.raises(RunError, match="README.md: is there already.*--force replaces it, --out FILE"):
        card.main([str(run)])
    assert card.main([str(run), "--out", str(tmp_path / "card.md")]) == 0
    assert (run / "README.md").read_text() == "mine" and (tmp_path / "card.md").is_file()


def test_one_run_is_asked_for(run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="expected one run directory"):
        card.main([str(tmp_path)])
    (run / "evaluation" / "metrics.json").write_text("{}")
    with pytest.raises(RunError, match="metrics.json: field 'schema'"):
        card.main([str(run)])


def test_the_whole_report(tmp_path, capsys):
    sweep = report_runs.write_sweep(tmp_path / "sweep")
    assert cli.main(["report", str(sweep)]) == 0
    shown = capsys.readouterr()
    files = ["report.html", "results.md", "tables.tex", "numbers.csv"]
    assert sorted(p.name for p in (sweep / "report").iterdir()) == sorted(files)
    lines = shown.out.splitlines()
    assert lines[-4] == f"page: {(sweep / 'report' / 'report.html').as_uri()}" and len(lines) == 6
    assert [line.split("gausim ")[1].split()[0] for line in lines[-3:]] == ["view", "simulate", "train"]
    told = "toy_bunny, predicted by gausim: On frames never seen (16–49; mean of 2 seeds), its points"
    assert lines[1].startswith(told)
    assert "wrote" not in shown.out and "pictures of toy_bunny" in shown.err
    assert "5 runs: 3 evaluated, 1 failed, 1 unfinished" in shown.out
    page = (sweep / "report" / "report.html").read_text()
    # Three pictures, three videos of runs with a poster each, and one of both rows side by side.
    kinds = [page.count(f"data:{kind};base64,") for kind in ("image/webp", "image/jpeg", "video/mp4")]
    assert kinds == [3, 3, 4]
    # The report does not take itself for a run.
    folders = [str(sweep / "full"), str(sweep / "no_mass")]
    out = tmp_path / "elsewhere"
    assert cli.main(["report", str(sweep), "--out", str(out), "--no-pictures"]) == 0
    assert "5 runs: 3 evaluated, 1 failed, 1 unfinished" in capsys.readouterr().out
    assert cli.main(["report", *folders, "--out", str(out), "--title", "Mine & yours", "--no-pictures"]) == 0
    page = (out / "report.html").read_text()
    assert "<h1>Mine &amp; yours</h1>" in page and "data:image" not in page
    assert not (sweep / "full" / "report").exists()
    assert cli.main(["report", str(tmp_path / "nowhere")]) == 2
    assert "no such directory" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()
