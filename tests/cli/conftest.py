"""What tests of commands share: toy data sets and runs of the session, and evaluations in this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import joint_runs
from helpers.toy_object import write_toy_object

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.runs.directory import RunDirectory


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy object, which no test changes."""
    return write_toy_object(tmp_path_factory.mktemp("data") / "toy").root


@pytest.fixture(scope="session")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another object, which no test changes."""
    return joint_runs.other_object(tmp_path_factory.mktemp("stores") / "other")


@pytest.fixture(scope="session")
def joint(toy: Path, other: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of both objects, the second pinned by its own selection; not to be changed."""
    run = tmp_path_factory.mktemp("joint") / "seed_0"
    asked = ["data=joint", joint_runs.both(toy, other), "data.batch_size=3", f"hydra.run.dir={run}"]
    assert command.main([*joint_runs.TINY, *asked, "optimizer.ema_decay=0.5"]) == 0
    return run


@pytest.fixture
def evaluated_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training with `evaluate=true` evaluates in this process, which spares the imports of another."""

    def evaluate_run(run: RunDirectory) -> None:
        assert evaluate.main([str(run.path)]) == 0

    monkeypatch.setattr(command, "_evaluate", evaluate_run)
