"""Runs of two ranks through the command line: killed and resumed to the same bits, one after the other in a sweep."""

from __future__ import annotations

import json
import os
import random
import runpy
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import toy_object

from gausim.runs.checkpoint import digest, read_checkpoint

HERE = Path(__file__).parent
SHARED = runpy.run_path(str(HERE / "test_resume_exact.py"))
assert_same_run, table = SHARED["assert_same_run"], SHARED["table"]
TWO = ("trainer=ddp", "data.batch_size=2", "trainer.timeout_minutes=2")
STEP = "gausim.training.module.GausSimModule.training_step"

Train = Callable[..., "tuple[int, str]"]


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Train]:
    """Trains in a process of its own on three sequences: name, overrides and how it dies."""
    folder = tmp_path_factory.mktemp("ranks")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(toy_object.AMPLITUDES, "seq_002", 0.3)
        root = toy_object.write_toy_object(folder / "toy").root
    tiny = [x for x in SHARED["TINY"] if x != "trainer=cpu"]
    given = (f"data.root={root}", f"paths.output_root={folder}", *tiny)
    program = [sys.executable, str(HERE.parent / "helpers" / "killed_runs.py")]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdin is not None and server.stdout is not None

        def order(name: str, *overrides: str, **death: Any) -> tuple[int, str]:
            server.stdin.write(json.dumps({"argv": [*given, f"name={name}", *overrides], **death}) + "\n")
            server.stdin.flush()
            found = json.loads(server.stdout.readline())
            return found["status"], found["output"]

        order.folder = folder  # type: ignore[attr-defined]
        yield order
        server.stdin.close()


def run_of(train: Train, name: str, seed: int = 0) -> Path:
    return train.folder / name / f"seed_{seed}"  # type: ignore[attr-defined]


def killed(count: int, rank: int, target: str = STEP, when: str = "before") -> dict[str, Any]:
    return {"die": [{"target": target, "match": "", "count": count, "when": when, "rank": rank}]}


@pytest.fixture(scope="module")
def whole(train: Train) -> Path:
    status, output = train("whole", *TWO, "trainer.max_epochs=3")
    assert status == 0, output
    assert "training on cpu (2 ranks, 1 threads)" in output and output.count("epoch 1/3") == 1
    return run_of(train, "whole")


def test_a_rank_that_is_killed_ends_the_run_and_the_same_command_continues_to_the_same_bits(
    train: Train, whole: Path
) -> None:
    settings = (*TWO, "trainer.max_epochs=3", "callbacks.checkpoint.every_steps=2")
    began = time.monotonic()
    status, output = train("cut", *settings, **killed(6, rank=1))
    assert status == 2, output
    last = output.strip().splitlines()[-1]
    assert "error: rank 1 was ended by signal 9" in output and "the same command continues" in last, output
    assert "Traceback" not in output and time.monotonic() - began < 110  # not after trainer.timeout_minutes
    run = run_of(train, "cut")
    assert not (run / "FINISHED").exists() and read_checkpoint(run / "last.ckpt")["global_step"] == 5
    status, output = train("cut", *settings)
    assert status == 0 and "resuming on cpu (2 ranks" in output, output
    assert_same_run(run, whole)


@pytest.mark.slow
def test_the_first_rank_is_killed_and_the_same_command_continues_to_the_same_bits(train: Train, whole: Path) -> None:
    settings = (*TWO, "trainer.max_epochs=3", "callbacks.checkpoint.every_steps=2")
    assert train("first", *settings, **killed(3, rank=0))[0] == -9
    assert train("first", *settings, **killed(2, rank=0, target="gausim.runs.checkpoint._check_written"))[0] == -9
    assert train("first", *settings, **killed(4, rank=0))[0] == -9
    status, output = train("first", *settings)
    assert status == 0, output
    assert_same_run(run_of(train, "first"), whole)


@pytest.mark.slow
def test_two_ranks_learn_what_one_does(train: Train, whole: Path) -> None:
    status, output = train("alone", "trainer=cpu", "data.batch_size=2", "trainer.max_epochs=3")
    assert status == 0, output
    for row, expected in zip(table(whole / "epochs.csv"), table(run_of(train, "alone") / "epochs.csv"), strict=True):
        assert row.keys() == expected.keys()
        for name, value in expected.items():
            assert row[name] == value or float(row[name]) == pytest.approx(float(value), rel=2e-3), name


@pytest.mark.slow
@pytest.mark.parametrize("search", [False, True])
def test_jobs_of_a_sweep_follow_each_other_with_two_ranks_each(train: Train, search: bool) -> None:
    settings, name = (*TWO, "trainer.max_epochs=2"), f"swept_{search}"
    optuna = ("hydra/sweeper=optuna", "hydra.sweeper.n_trials=3", "hydra.sweeper.pruner=null",
              "optimizer.network_lr=tag(log,interval(1e-4,1e-2))")  # fmt: skip
    grid = ("optimizer.network_lr=0.001,0.002,0.003",)
    status, output = train(name, *settings, *(optuna if search else grid), "-m")
    assert status == 0, output
    assert output.count("(2 ranks, ") == 3 and "sweep of 3 jobs: 3 trained" in output and "Traceback" not in output
    jobs = [marker.parent for marker in (train.folder / name).rglob("FINISHED")]  # type: ignore[attr-defined]
    rates = {yaml.safe_load((job / "config.yaml").read_text())["optimizer"]["network_lr"] for job in jobs}
    assert len(jobs) == len(rates) == 3
    for job in jobs[:2]:  # what a run of its own learns with the job's rate: all ranks had it
        rate = yaml.safe_load((job / "config.yaml").read_text())["optimizer"]["network_lr"]
        status, output = train(f"alone_{job.parent.name[-8:]}", *settings, f"optimizer.network_lr={rate}")
        assert status == 0, output
        assert_same_run(job, run_of(train, f"alone_{job.parent.name[-8:]}"))


@pytest.mark.slow
def test_two_ranks_killed_at_random_moments(train: Train) -> None:
    settings = (*TWO, "trainer.max_epochs=12", "data.repeats=6", "callbacks.checkpoint.every_steps=3")
    status, output = train("undisturbed", *settings)
    assert status == 0, output
    moments = random.Random(1)
    for number in range(4):
        death = killed(moments.randint(2, 20), rank=number % 2, when=moments.choice(("before", "after")))
        assert train("disturbed", *settings, **death)[0] == (2 if number % 2 else -9)
    status, output = train("disturbed", *settings)
    assert status == 0, output
    assert_same_run(run_of(train, "disturbed"), run_of(train, "undisturbed"))


@pytest.mark.slow
def test_ranks_that_a_scheduler_has_started_meet_and_train(train: Train, whole: Path, tmp_path: Path) -> None:
    """Two processes with SLURM's variables, as srun and submitit start them."""
    config = yaml.safe_load((whole / "config.yaml").read_text())
    config["paths"]["output_root"], config["name"] = str(tmp_path), "scheduled"
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
    ranks = [
        subprocess.Popen(
            command,
            env={**os.environ, **slurm, "SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in (0, 1)
    ]
    outputs = [rank.communicate(timeout=240)[0] for rank in ranks]
    assert [rank.returncode for rank in ranks] == [0, 0], outputs
    assert "2 ranks" in outputs[0] and "epoch 3/3" in outputs[0] and "epoch" not in outputs[1]
    found, expected = (read_checkpoint(r / "last.ckpt")["state_dict"] for r in (run, whole))
    assert digest(found) == digest(expected)
