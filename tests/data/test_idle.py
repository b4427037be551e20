"""Sequences that teach nothing are named, whether or not the doctor is asked."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import mistakes

from gausim.data.idle import idle_sequences
from gausim.data.objects import ObjectData


def still(root: Path) -> None:
    for folder in (root / "sequences/seq_001").glob("*/"):
        mistakes.reorder(folder, lambda number: 0)


def black(root: Path) -> None:
    mistakes.every_image(root, lambda p: np.dstack((0 * p[..., :3], p[..., 3])), "seq_001/*/*")


KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "sound": (lambda root: None, ""),
    "one camera still": (lambda root: mistakes.reorder(root / "sequences/seq_001/cam_0", lambda number: 0), ""),
    "still": (still, "nothing moves (the frames of every training view are one picture) in seq_001."),
    "black": (black, "the object is black in seq_001."),
    "empty": (lambda root: mistakes.every_image(root, np.zeros_like, "seq_001/*/*"),
              "nothing is visible (alpha is 0 in all training views) in seq_001."),
    "all empty": (lambda root: mistakes.every_image(root, np.zeros_like), "training views) in seq_000, seq_001."),
    "opaque": (lambda root: mistakes.every_image(root, lambda p: np.dstack((0 * p[..., :3], 255 + 0 * p[..., 3]))),
               "black in seq_000, seq_001."),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_idle_sequences_are_named(kind: str, toy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(toy, tmp_path / "data")
    spoil, expected = KINDS[kind]
    spoil(root)
    told = list(idle_sequences([ObjectData(root)]))
    assert [expected in text for text in told] == [True] * bool(expected)
