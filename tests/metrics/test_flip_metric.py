from __future__ import annotations

import numpy as np
import pytest
import torch

from gausim.core import ConfigError
from gausim.metrics import FLIP
from gausim.metrics.flip import flip_map


def pair(height: int = 48, width: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture of waves, and the same shifted and duller: (prediction, target)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = [0.5 + 0.5 * np.sin(0.31 * x + 0.2 * y), 0.5 + 0.5 * np.sin(0.17 * x - 0.4 * y + 1),
             0.5 + 0.4 * np.cos(0.05 * x * y / 8)]  # fmt: skip
    target = np.stack(waves, -1)
    prediction = np.clip(0.85 * np.roll(target, 3, 1) + 0.05, 0, 1)
    return torch.tensor(prediction, dtype=torch.float32)[None], torch.tensor(target, dtype=torch.float32)[None]


# Computed by the authors' program (flip-evaluator 1.7) for these pictures; None is its default viewing condition.
@pytest.mark.parametrize(("density", "expected"), [(None, 0.7077324390411377), (20.0, 0.7386605143547058)])
def test_agrees_with_the_authors_program(density, expected):
    metric = FLIP() if density is None else FLIP(density)
    metric.update(*pair(), torch.ones(1, 48, 64, dtype=torch.bool))
    assert float(metric.compute()) == pytest.approx(expected, abs=2e-5)


def test_single_pixels_agree_too():
    found = flip_map(*pair())[0]
    assert float(found[0, 0]) == pytest.approx(0.976476, abs=2e-5)
    assert float(found[20, 30]) == pytest.approx(0.79611987, abs=2e-5)


@pytest.mark.parametrize("shape", [(33, 70), (70, 33), (6, 9)])
def test_maps_agree_with_the_authors_program_where_it_is_installed(shape):
    flip_evaluator = pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed (extra 'dev')")
    generator = np.random.default_rng(3)
    first, second = (generator.random((*shape, 3)).astype(np.float32) for _ in range(2))
    expected = flip_evaluator.evaluate(second, first, "LDR", applyMagma=False)[0][..., 0]
    found = flip_map(torch.from_numpy(first)[None], torch.from_numpy(second)[None])[0].numpy()
    assert np.abs(found - expected).max() < 1e-4


def test_same_images_differ_by_nothing_and_opposite_ones_by_much():
    image = pair()[0]
    assert float(flip_map(image, image).max()) < 1e-6
    black, white = torch.zeros(1, 20, 30, 3), torch.ones(1, 20, 30, 3)
    assert 0.9 < float(flip_map(black, white).min()) <= float(flip_map(black, white).max()) <= 1.0


def test_images_of_a_batch_do_not_touch_each_other():
    first, second = pair()
    batch = flip_map(torch.cat((first, second)), torch.cat((second, second)))
    assert torch.allclose(batch[0], flip_map(first, second)[0], atol=1e-6)
    assert float(batch[1].max()) < 1e-6


def test_a_wrong_viewing_condition_is_refused():
    with pytest.raises(ConfigError, match="pixels_per_degree is 0"):
        FLIP(0)
