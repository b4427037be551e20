from __future__ import annotations

import pytest
import torch
from helpers.waves import pair

from gausim.core import ConfigError
from gausim.metrics import FLIP
from gausim.metrics import image as flip


def test_each_image_of_a_batch_is_measured_by_itself() -> None:
    pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed (extra 'flip')")
    first, second = pair()
    found = FLIP().per_image(torch.cat((first, second)), torch.cat((second, second)), torch.ones(2, 48, 64).bool())
    # The first is what a second form of the method, written from the paper, gave for these pictures.
    assert found.tolist() == pytest.approx([0.7077324390411377, 0.0], abs=2e-5)


def test_without_the_package_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flip, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install flip-evaluator"):
        FLIP()
