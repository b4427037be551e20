"""Fixtures of the commands' tests: a second toy object, a joint run, and evaluations in this process."""

from pathlib import Path

import pytest
from helpers import joint_runs
from helpers.shared import Shared

from gausim.cli import evaluate, training_run
from gausim.cli import train as command
from gausim.runs.directory import RunDirectory


@pytest.fixture(scope="session")
def other(shared: Shared) -> Path:
    """Another object, which no test changes."""
    return shared("other", joint_runs.other_object)


@pytest.fixture(scope="session")
def joint(toy: Path, other: Path, shared: Shared) -> Path:
    """A run of both objects, the second pinned by its own selection; not to be changed."""

    def train(run: Path) -> None:
        asked = ["data=joint", joint_runs.both(toy, other), "plan.batch_size=3", f"hydra.run.dir={run}"]
        assert command.main([*joint_runs.TINY, *asked]) == 0

    return shared("joint", train)


@pytest.fixture(autouse=True)
def quick(quick_evaluations: None) -> None:
    """All evaluations."""


@pytest.fixture
def evaluated_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training with `evaluate=true` evaluates in this process, which spares the imports of another."""

    def evaluate_run(run: RunDirectory) -> None:
        assert evaluate.main([str(run.path)]) == 0

    monkeypatch.setattr(training_run, "_evaluate", evaluate_run)
