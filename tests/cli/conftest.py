"""What tests of commands share: one toy data set of the session, and evaluations in this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.toy_object import write_toy_object

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.runs.directory import RunDirectory


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy object, which no test changes."""
    return write_toy_object(tmp_path_factory.mktemp("data") / "toy").root


@pytest.fixture
def evaluated_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training with `evaluate=true` evaluates in this process, which spares the imports of another."""

    def evaluate_run(run: RunDirectory) -> None:
        assert evaluate.main([str(run.path)]) == 0

    monkeypatch.setattr(command, "_evaluate", evaluate_run)
