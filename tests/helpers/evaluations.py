"""Evaluations without what takes most of their time."""

from __future__ import annotations

import pytest

from gausim.evaluation import evaluation
from gausim.runs import cost


def make_quick(patch: pytest.MonkeyPatch) -> None:
    """FLIP takes half of an evaluation, and collecting garbage before the memory is counted most of a prediction."""
    patch.setattr(evaluation, "flip_is_installed", lambda: False)
    patch.setattr(cost, "_begin", lambda cuda: None)
