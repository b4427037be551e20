"""What tests of commands share: evaluations in this process."""

from __future__ import annotations

import pytest

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.runs.directory import RunDirectory


@pytest.fixture
def evaluated_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training with `evaluate=true` evaluates in this process, which spares the imports of another."""

    def evaluate_run(run: RunDirectory) -> None:
        assert evaluate.main([str(run.path)]) == 0

    monkeypatch.setattr(command, "_evaluate", evaluate_run)
