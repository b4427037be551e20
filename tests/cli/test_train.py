from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from helpers.simulators import LEVELS
from helpers.toy_object import write_toy_object

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.core import ConfigError, RunError
from gausim.runs.checkpoint import read_checkpoint

TINY = (
    "model=gausim_paper", "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS,
    "data.curriculum.t_max=2", "data.curriculum.t_start=1", "data.repeats=1", "data.batch_size=2",
    "trainer.max_epochs=2", "trainer.accelerator=cpu",
    "trainer.progress=false", "trainer.threads=1", "render=reference", "doctor=false", "name=toy",
    "callbacks.panels.every_epochs=1",
)  # fmt: skip


@pytest.fixture
def arguments(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return [f"data.root={toy}", *TINY]


@pytest.fixture(scope="module")
def finished(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one epoch, which tests copy."""
    root = tmp_path_factory.mktemp("finished")
    assert command.main([f"data.root={toy}", *TINY, "trainer.max_epochs=1", f"paths.output_root={root}"]) == 0
    return root


@pytest.fixture
def again(arguments: list[str], finished: Path, tmp_path: Path) -> list[str]:
    """The arguments of a run that is finished here already."""
    shutil.copytree(finished, tmp_path / "outputs")
    return [*arguments, "trainer.max_epochs=1"]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(run / "last.ckpt")["state_dict"]


def test_a_run_leaves_everything_and_loads_again(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([*arguments, "optimizer.initial_lr=0.01"]) == 0
    run = Path("outputs/toy/seed_0")
    assert {"config.yaml", "FINISHED", "last.ckpt", "epochs.csv", "panels", "tensorboard", "csv"} <= {
        p.name for p in run.iterdir()
    }
    rows = list(csv.DictReader((run / "epochs.csv").open()))
    assert [(r["epoch"], float(r["steps"])) for r in rows] == [("1", 1.0), ("2", 2.0)]
    assert [p.name for p in sorted((run / "panels").iterdir())] == ["step_000001", "step_000002"]
    printed = capsys.readouterr().out
    assert "36 kernels" in printed
    assert "warning: in 2 shows at optimizer.initial_lr=" in printed and "diagonal at most" in printed
    result, address, *following = printed.splitlines()[-4:]
    assert result.startswith("Trained for 2 epochs (") and "times that of a model that predicts no motion" in result
    assert address == f"run: {run.resolve().as_uri()}"
    assert [line.split("gausim ")[1].split()[0] for line in following] == ["evaluate", "report"]
    loaded = load_run(run)
    assert not loaded.module.training and loaded.objects[0].name == "toy"
    for name, value in loaded.module.state_dict().items():
        torch.testing.assert_close(value, weights(run)[name])


def test_faults_of_the_data_are_told_again_at_the_end(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    one_view = Path(shutil.copytree(toy, tmp_path / "one_view"))
    facts = json.loads((one_view / "dataset.json").read_text())
    views = facts["train_views"] + facts["heldout_views"]
    (one_view / "dataset.json").write_text(json.dumps({**facts, "train_views": views[:1], "heldout_views": views[1:]}))
    ends = []
    for root in (toy, one_view):
        asked = [f"data.root={root}", *TINY, "doctor=true", "trainer.max_epochs=1", f"name={root.name}_end"]
        assert command.main(asked) == 0
        end = capsys.readouterr().out
        ends.append(end[end.index("Trained for") :])
    assert "faulty" not in ends[0]
    assert "The data are faulty" in ends[1] and "one training view only" in ends[1] and "gausim doctor" in ends[1]
    finished = json.loads(Path("outputs/one_view_end/seed_0/FINISHED").read_text())
    assert ["one training view only" in fault for fault in finished["data_faults"]].count(True) == 1


def test_motion_and_data_are_looked_at_and_training_does_not_notice(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main([*arguments, "name=watched", "callbacks.motion.every_epochs=1", "doctor=true"]) == 0
    told = capsys.readouterr().out
    assert "WARNING  extent" in told and "frames of each sequence only" in told and "NOTE" not in told
    assert command.main([*arguments, "name=alone", "callbacks.motion=null"]) == 0
    assert "WARNING" not in capsys.readouterr().out
    watched, alone = (Path(f"outputs/{name}/seed_0") for name in ("watched", "alone"))
    rows = list(csv.DictReader((watched / "motion.csv").open()))
    assert [(r["epoch"], r["object"]) for r in rows] == [("1", "toy"), ("2", "toy")]
    assert not (alone / "motion.csv").exists()
    for name, value in weights(alone).items():
        assert torch.equal(value, weights(watched)[name]), name
    assert evaluate.main([str(watched)]) == 0
    capsys.readouterr()
    found = json.loads((watched / "evaluation" / "metrics.json").read_text())["objects"]["toy"]
    own, still = (found["rows"][row]["unseen"]["points"]["error_3d"]["mean"] for row in ("gausim", "static"))
    assert float(rows[-1]["error_unseen"]) == pytest.approx(own / still, rel=1e-3)
    row = found["diagnosis"]["rows"]["gausim"]
    assert float(rows[-1]["error_level_1"]) == pytest.approx(row["level_errors"][0], rel=1e-3)


def test_a_finished_run_is_refused_and_can_be_overwritten(again: list[str]) -> None:
    with pytest.raises(RunError, match=r"finished.*name=NAME.*overwrite=true"):
        command.main(again)
    assert command.main([*again, "overwrite=true"]) == 0


def test_resuming_at_an_epochs_end_equals_an_uninterrupted_run(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from gausim.training.callbacks.resume import RunCheckpoint

    command.main([*arguments, "name=whole"])
    saved = RunCheckpoint.on_train_epoch_end

    def crash(self: RunCheckpoint, trainer: object, pl_module: object) -> None:
        saved(self, trainer, pl_module)  # type: ignore[arg-type]
        raise MemoryError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(RunCheckpoint, "on_train_epoch_end", crash)
        with pytest.raises(MemoryError):
            command.main([*arguments, "name=cut"])
    assert not Path("outputs/cut/seed_0/FINISHED").exists()
    command.main([*arguments, "name=cut", "logger=none"])
    whole, cut = (weights(Path(f"outputs/{name}/seed_0")) for name in ("whole", "cut"))
    for name, value in whole.items():
        torch.testing.assert_close(cut[name], value, rtol=0, atol=0)


def test_a_changed_config_is_refused_by_the_name_of_its_keys(again: list[str]) -> None:
    Path("outputs/toy/seed_0/FINISHED").unlink()
    with pytest.raises(RunError, match=r"changed: loss\.image\.window, loss\.static_weight\."):
        command.main([*again, "loss.static_weight=2", "loss.image.window=7"])


def test_a_run_of_a_version_with_other_settings_goes_on(again: list[str]) -> None:
    """Its configuration said what is left to defaults now, and had other names."""
    run = Path("outputs/toy/seed_0")
    old = yaml.safe_load((run / "config.yaml").read_text())
    assert old["loss"]["explosion"] == 3.0 and old["trainer"]["clock"] == "wall"  # though no configuration lists them
    del old["loss"]["explosion"], old["overwrite"]
    old |= {"supervision": {}, "experiment": {"name": "toy"}, "ablation": {"name": "none"}}
    old["trainer"]["overwrite"] = False
    (run / "config.yaml").write_text(yaml.safe_dump(old))
    (run / "FINISHED").unlink()
    assert command.main(again) == 0
    assert load_run(run).config["trainer"].get("overwrite") is None


def test_an_unknown_key_is_refused(arguments: list[str]) -> None:
    with pytest.raises(ConfigError, match="modle"):
        command.main([*arguments, "modle=gausim"])
    assert not Path("outputs").exists()


@pytest.mark.usefixtures("again")
def test_a_checkpoint_of_another_scene_is_refused(tmp_path: Path) -> None:
    other = write_toy_object(tmp_path / "other")
    from dataclasses import replace

    from gausim.io.ply import save_scene

    save_scene(replace(other.scene, means=other.scene.means * 1.01), other.root / "scene.ply")
    with pytest.raises(RunError, match=r"trained on 'toy' \(36 kernels.*but the data holds 'toy' \(36 kernels"):
        load_run(Path("outputs/toy/seed_0"), data={"root": str(other.root)})


def test_help_needs_no_hydra(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--help"]) == 0
    assert "usage: gausim train" in capsys.readouterr().out


def test_a_run_may_be_evaluated_when_it_is_trained(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    import subprocess

    calls: list[list[str]] = []
    status = [1]

    def run(command: list[str], *, env: dict[str, str]) -> object:
        calls.append(command[1:])
        assert env["OMP_NUM_THREADS"] == "1"
        return subprocess.CompletedProcess(command, status[0])

    monkeypatch.setattr(subprocess, "run", run)
    asked = [*arguments, "trainer.max_epochs=1", "evaluate=true"]
    with pytest.raises(RunError, match=r"trained, but its evaluation failed with exit status 1.*same command"):
        command.main(asked)
    made = weights(Path("outputs/toy/seed_0"))
    status[0] = 0
    assert command.main(asked) == 0  # the finished run is evaluated, not trained again and not refused
    assert calls == 2 * [["-m", "gausim.cli.main", "evaluate", "outputs/toy/seed_0"]] or calls[0][-1].endswith("seed_0")
    assert all(torch.equal(value, made[name]) for name, value in weights(Path("outputs/toy/seed_0")).items())
    evaluated = Path("outputs/toy/seed_0/evaluation/metrics.json")
    evaluated.parent.mkdir()
    evaluated.write_text("{}")
    with pytest.raises(RunError, match="finished"):
        command.main(asked)
    with pytest.raises(RunError, match="finished"):
        command.main([*asked, "loss.static_weight=2"])
    assert len(calls) == 2
