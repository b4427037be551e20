from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
from helpers import toy_object
from helpers.played import stand_in

from gausim.cli import evaluate, evaluate_run, simulate_run
from gausim.compose import build
from gausim.core import DataError, SimState


@pytest.fixture
def run(toy, tmp_path, monkeypatch):
    """A run whose model knows the toy's formula and reads the sequence from its initial state."""
    toy = toy_object.ToyObject(toy, toy_object.toy_scene())
    names = list(toy.amplitudes)
    initial = SimpleNamespace(state=lambda sequence: SimState(toy.scene.means, toy.scene.means + sequence))

    def rollout(state, steps):
        return toy.truth(names[round(float((state.previous - toy.scene.means).mean()))], frames=steps + 1)

    model = SimpleNamespace(scenes=[toy.scene], dynamics=lambda scene_id: SimpleNamespace(rollout=rollout))

    def predict(sequence, steps):
        return rollout(SimState(toy.scene.means, initial.state(sequence).previous), steps)

    loaded = stand_in(tmp_path / "run", toy.root, model=model, initial_states=initial, predict=predict)
    for home in (evaluate_run, simulate_run, build):
        monkeypatch.setattr(home, "load_run", lambda path, data=None: loaded)
    return loaded


def test_whole_evaluation(run, capsys):
    assert evaluate.main([str(run.run_dir)]) == 0
    captured = capsys.readouterr()
    folder = run.run_dir / "evaluation"
    assert "`gausim prepare lpips` gets them" in (folder / "table.md").read_text()
    lines = captured.out.splitlines()
    assert lines[0].startswith("toy: On frames never seen") and "it foresees the motion closely." in lines[0]
    assert lines[1] == f"tables: {(folder / 'table.md').as_uri()}" and lines[2] == f"next: gausim report {run.run_dir}"
    assert len(lines) == 4 and "not finished" not in captured.err
    names = {p.name for p in folder.iterdir()}
    assert names == {"metrics.json", "metrics.npz", "pictures.npz", "table.md", "errors_toy.png", "motion_toy.png"}
    summary = json.loads((folder / "metrics.json").read_text())
    expected = {"name": "toy", "seed": 5, "views": "all", "finished": True, "epoch": 3, "updates": 40}
    assert summary["run"] == expected
    row = summary["objects"]["toy"]["rows"]["gausim"]["unseen"]
    assert row["points"]["error_3d"]["ratio"] < 1e-3 and row["heldout"]["l2"]["mean"] < 0.003


def test_a_part_does_not_overwrite_the_whole(run, capsys):
    assert evaluate.main([str(run.run_dir), "--sequences", "seq_001", "--views", "heldout", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["objects"]["toy"]["sequences"] == ["seq_001"]
    assert set(printed["objects"]["toy"]["rows"]["static"]["seen"]) == {"heldout", "points"}
    assert not (run.run_dir / "evaluation" / "metrics.json").exists()
    assert (run.run_dir / "evaluation" / "partial" / "metrics.json").is_file()


def test_an_unfinished_run_is_measured_with_a_warning_and_lists_its_tables_on_demand(run, capsys):
    (run.run_dir / "FINISHED").unlink()
    here = ["--out", str(run.run_dir / "here")]
    assert evaluate.main([str(run.run_dir), "--verbose", "--sequences", "seq_000", *here]) == 0
    told = capsys.readouterr()
    assert "warning" in told.err and "views never trained on" in told.out
    assert f"wrote {run.run_dir / 'here' / 'metrics.npz'}" in told.out
    assert told.out.splitlines()[-1] == f"next: gausim evaluate {run.run_dir}"  # a part leads to the whole
    assert json.loads((run.run_dir / "here" / "metrics.json").read_text())["run"]["finished"] is False


def test_what_is_not_there_is_named(run):
    with pytest.raises(DataError, match=r"no object \['cat'\]; it has \['toy'\]"):
        evaluate.main([str(run.run_dir), "--object", "cat"])
    with pytest.raises(DataError, match="no sequence .*seq_7"):
        evaluate.main([str(run.run_dir), "--sequences", "seq_7"])
