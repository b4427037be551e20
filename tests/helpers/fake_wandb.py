"""Weights & Biases without a server: a module that keeps what its runs are sent."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest


class FakeRun:
    """A run that keeps its rows, and how it was ended."""

    def __init__(self, given: dict[str, Any], start: int, number: int) -> None:
        self.given, self.starting_step = given, start
        self.rows: list[tuple[int, dict[str, Any]]] = []
        self.exits: list[int] = []
        folder = Path(given["dir"]) / "wandb" / f"offline-run-{number}-{given['id']}" / "files"
        folder.mkdir(parents=True)
        self.dir = str(folder)

    def log(self, values: dict[str, Any], step: int | None = None, commit: bool | None = None) -> None:
        assert not self.exits, "logged after its end"
        if values:
            assert step is not None and (not self.rows or step >= self.rows[-1][0]), "steps must not go back"
            self.rows.append((step, values))
        np.random.rand()  # a library may draw; training must not notice

    def finish(self, exit_code: int) -> None:
        self.exits.append(exit_code)


def fake_wandb(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Replaces wandb by one whose server has the steps before ``start``; ``runs`` are those that it was asked for."""
    module = MagicMock(runs=[], start=0, Error=type("Error", (Exception,), {}))

    def init(**given: Any) -> FakeRun:
        np.random.rand()
        module.runs.append(FakeRun(given, module.start, len(module.runs)))
        return module.runs[-1]

    module.init.side_effect = init
    monkeypatch.setitem(sys.modules, "wandb", module)
    return module
