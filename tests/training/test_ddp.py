"""Several ranks do together what one rank does with all sequences (see rank_checks.py for what runs in them)."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.plain import digest
from helpers.toy_runs import Trainings, assert_same_run, killed, rows
from lightning.pytorch.utilities import rank_zero_only

from gausim.runs.checkpoint import read_checkpoint
from gausim.training.ranks.launch import claim_first
from gausim.training.trainer import TrainerSettings, make_trainer

# The static loss is one rank's: all that could depend on which rank computes a sequence.
ALL = {"static_probability": 1.0}

Ask = Callable[..., list[Any]]


@pytest.fixture(scope="module")
def ask(trainings: Trainings) -> Ask:
    """Asks for a check in so many ranks; returns what each found."""
    return lambda check, ranks, **options: trainings.ask(check=check, ranks=ranks, options=options)


def distance(found: dict[str, Any], expected: dict[str, Any]) -> float:
    """Norm of the difference over the norm of what is expected; both lack the same entries."""
    assert {n for n, v in found.items() if v is None} == {n for n, v in expected.items() if v is None}
    pairs = [(np.array(found[n]), np.array(v)) for n, v in expected.items() if v is not None]
    return float(np.sqrt(sum(((a - b) ** 2).sum() for a, b in pairs) / sum((b**2).sum() for _, b in pairs)))


def assert_as_one(found: list[Any], alone: Any, tolerance: float, rounding: float = 1e-4) -> None:
    assert all(isinstance(answer, dict) for answer in (*found, alone)), (found, alone)
    for name in ("weights", "stats", "statistics", "baselines"):
        assert all(rank[name] == found[0][name] for rank in found), f"{name} differ between ranks"
    assert distance(found[0]["grads"], alone["grads"]) <= tolerance
    assert distance(found[0]["statistics"], alone["statistics"]) <= tolerance
    assert found[0]["baselines"] == alone["baselines"]
    for mine, theirs in zip(found[0]["stats"], alone["stats"], strict=True):
        assert mine == pytest.approx(theirs, rel=rounding, abs=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-12)])
def test_the_gradient_of_a_step_is_that_of_one_rank(ask: Ask, dtype: str, tolerance: float) -> None:
    alone = ask("train", 1, count=5, dtype=dtype, objective=ALL)[0]
    assert alone["grads"]["initial_states.offset.5"] is None and alone["grads"]["initial_states.offset.4"] is not None
    assert_as_one(ask("train", 2, count=5, dtype=dtype, objective=ALL), alone, tolerance)


@pytest.mark.parametrize(("ranks", "options", "tolerance"), [
    (2, {"count": 5, "times": 3, "objective": {**ALL, "backprop_steps": 2}}, 1e-9),  # steps follow each other
    (3, {"count": 1, "times": 2, "objective": ALL}, 1e-9),  # ranks without a sequence
    (2, {"count": 3, "objective": {"backprop_steps": 0}}, 1e-11),
    (2, {"count": 3, "objective": {"momentum_weight": 0.0}}, 1e-11),
])  # fmt: skip
def test_ranks_learn_what_one_does(ask: Ask, ranks: int, options: dict[str, Any], tolerance: float) -> None:
    found, alone = (ask("train", n, dtype="float64", **options) for n in (ranks, 1))
    assert_as_one(found, alone[0], tolerance)


@pytest.mark.parametrize(("limit", "ends"), [(0.3, "in between"), (1e-4, "at once")])
def test_a_rollout_ends_on_all_ranks_where_it_ends_on_one(ask: Ask, limit: float, ends: str) -> None:
    options = {"count": 3, "dtype": "float64", "steps": 5, "wild": 2.2,
               "objective": {"explosion": limit, "static_probability": 1.0}}  # fmt: skip
    alone = ask("train", 1, **options)[0]
    assert alone["stats"][0]["exploded"] == 1.0
    assert ("loss_image" in alone["stats"][0]) == (ends != "at once")
    assert_as_one(ask("train", 2, **options), alone, 1e-9)


def test_metrics_of_an_uneven_set_are_those_of_all_of_it(ask: Ask) -> None:
    (alone,) = ask("metrics", 1, count=5)
    for ranks in (2, 4, 6):  # of six, one has no image
        assert ask("metrics", ranks, count=5) == [pytest.approx(alone, rel=1e-12)] * ranks


def test_ranks_that_die_fail_or_drift_apart_are_noticed(ask: Ask) -> None:
    found = ask("fail", 3)
    assert found[1] is None and all("gloo" in answer for answer in (found[0], found[2]))
    value, other = ask("first", 2)
    assert value.startswith("one answer; ValueError: from ")
    assert other.startswith("one answer; RunError: rank 1: the first rank")
    found = ask("drifted", 4)
    assert all("weights: expected the same on all ranks" in text and "ranks [2, 3]" in text for text in found)
    expected = r"training diverged at predicted step 1 of 3, sequence toy/seq_0: positions are nan"
    found = ask("train", 2, count=3, wild=1e30)
    assert all(expected in answer["error"] for answer in found) and found[0] == found[1]


TWO = ("trainer=ddp", "trainer.accelerator=cpu", "plan.batch_size=2")
STEP = "gausim.training.module.GausSimModule.training_step"


@pytest.fixture(scope="module")
def whole(trainings: Trainings) -> Path:
    return trainings.whole("two_ranks", *TWO, "plan.epochs=3")


@pytest.mark.slow
def test_a_rank_that_is_killed_ends_the_run_and_the_same_command_continues_to_the_same_bits(trainings, whole) -> None:
    settings = (*TWO, "plan.epochs=3", "trainer.checkpoint_steps=2")
    began = time.monotonic()
    status, output = trainings("rank_cut", *settings, **killed(STEP, 6, rank=1))
    assert status in (2, -9), output  # by the broken connection, or by Lightning's observer of the other ranks
    assert status == -9 or "error: the connection to the other ranks is lost" in output, output
    assert time.monotonic() - began < 110  # not after the ranks' time limit
    run = trainings.run("rank_cut")
    assert not (run / "FINISHED").exists() and read_checkpoint(run / "last.ckpt")["global_step"] == 5
    assert trainings("rank_cut", *settings, **killed(STEP, 2, rank=0, when="after"))[0] == -9
    status, output = trainings("rank_cut", *settings)
    assert status == 0 and "resuming on cpu (2 ranks" in output, output
    assert_same_run(run, whole)


def test_a_run_of_two_ranks_learns_what_one_does(trainings: Trainings) -> None:
    status, output = trainings("both", *TWO, "plan.epochs=1")
    assert status == 0 and "training on cpu (2 ranks, 1 torch thread)" in output, output
    assert output.count("Trained for 1 epoch ") == 1
    status, output = trainings("alone", "trainer=cpu", "plan.batch_size=2", "plan.epochs=1")
    assert status == 0, output
    found, alone = (rows(trainings.run(name) / "epochs.csv") for name in ("both", "alone"))
    for row, expected in zip(found, alone, strict=True):
        assert row.keys() == expected.keys()
        for name, value in expected.items():
            assert row[name] == value or float(row[name]) == pytest.approx(float(value), rel=2e-3), name


@pytest.mark.slow
def test_two_ranks_begin_with_what_the_first_one_was_taught(trainings: Trainings) -> None:
    settings = ("model=gausim_network", "plan.teach.shows=2", "plan.teach.rolls=2", "plan.epochs=1")
    for name, own in (("both_taught", TWO), ("alone_taught", ("trainer=cpu", "plan.batch_size=2"))):
        status, output = trainings(name, *settings, *own)
        assert status == 0 and [output.count(f"  {stage}: ") for stage in ("track", "teach", "roll")] == [1] * 3, output
    found, alone = (rows(trainings.run(name) / "epochs.csv") for name in ("both_taught", "alone_taught"))
    assert len(found) == 1 and float(found[0]["loss_image"]) == pytest.approx(float(alone[0]["loss_image"]), rel=2e-3)


@pytest.mark.slow
def test_jobs_of_a_sweep_follow_each_other_with_two_ranks_each(trainings: Trainings) -> None:
    settings, name = (*TWO, "plan.epochs=2"), "swept"
    status, output = trainings(name, *settings, "optimizer.network_lr=0.001,0.002", "-m")
    assert status == 0, output
    assert output.count("(2 ranks, ") == 2 and "sweep of 2 jobs: 2 trained" in output and "Traceback" not in output
    jobs = [marker.parent for marker in (trainings.folder / name).rglob("FINISHED")]
    rates = {job: yaml.safe_load((job / "config.yaml").read_text())["optimizer"]["network_lr"] for job in jobs}
    assert len(jobs) == len(set(rates.values())) == 2
    for job, rate in rates.items():  # what a run of its own learns with the job's rate: all ranks had it
        status, output = trainings(f"alone_{job.parent.name[-8:]}", *settings, f"optimizer.network_lr={rate}")
        assert status == 0, output
        assert_same_run(job, trainings.run(f"alone_{job.parent.name[-8:]}"))


@pytest.mark.slow
def test_ranks_that_a_scheduler_has_started_meet_and_train(trainings: Trainings, whole: Path, tmp_path: Path) -> None:
    """Two processes with SLURM's variables, as srun and submitit start them."""
    config = yaml.safe_load((whole / "config.yaml").read_text())
    config["output_root"], config["name"] = str(tmp_path), "scheduled"
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "config.yaml").write_text(yaml.safe_dump(config))
    run = tmp_path / "scheduled" / "seed_0"
    command = [sys.executable, "-m", "gausim.cli.main", "train", "--config-dir", str(tmp_path / "given"),
               "--config-name", "config", f"hydra.run.dir={run}"]  # fmt: skip
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    slurm = {"SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "2", "SLURM_NNODES": "1", "SLURM_NODEID": "0",
             "SLURM_JOB_NAME": "train", "SLURM_NODELIST": "127.0.0.1", "MASTER_PORT": port}  # fmt: skip
    environments = [{**os.environ, **slurm, "SLURM_PROCID": n, "SLURM_LOCALID": n} for n in ("0", "1")]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    ranks = [subprocess.Popen(command, env=env, **pipes) for env in environments]
    outputs = [rank.communicate(timeout=240)[0] for rank in ranks]
    assert [rank.returncode for rank in ranks] == [0, 0], outputs
    assert "2 ranks" in outputs[0] and "Trained for 3 epochs" in outputs[0] and "Trained" not in outputs[1]
    found, expected = (read_checkpoint(r / "last.ckpt")["state_dict"] for r in (run, whole))
    assert digest(found) == digest(expected)


def test_variables_that_slurm_has_left_start_no_ranks(monkeypatch: pytest.MonkeyPatch) -> None:
    left = {"SLURM_NTASKS": "4", "SLURM_PROCID": "3", "SLURM_LOCALID": "3", "SLURM_JOB_NAME": "train"}
    for name, value in left.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(rank_zero_only, "rank", 3)
    claim_first({"devices": 2, "num_nodes": 1})
    assert rank_zero_only.rank == 3
    claim_first({"devices": 1, "num_nodes": 1})
    trainer = make_trainer(TrainerSettings(progress=False, accelerator="cpu"), epochs=1)
    assert rank_zero_only.rank == 0 and trainer.is_global_zero and trainer.world_size == 1
