"""Selections by place and colour, their combination, and masks made of them."""

from __future__ import annotations

import dataclasses
import re

import pytest
import torch
from helpers.plain import plain_scene

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene
from gausim.ops.selection import HalfSpace, NearPoints, apply_masks, parse_half_space, require_pinned


@pytest.fixture
def scene() -> GaussianScene:
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [0.0, 2.0, 0.4], [1.0, 2.0, 0.6]])
    sh = torch.zeros(4, 1, 3)
    sh[2, 0, 1] = 1.0  # one greenish kernel
    return plain_scene(means, sh=sh)


def selected(mask: torch.Tensor) -> list[int]:
    return mask.nonzero()[:, 0].tolist()


def test_half_spaces(scene: GaussianScene) -> None:
    assert selected(HalfSpace(2, below=0.4)(scene)) == [0, 1]
    assert selected(HalfSpace(2, above=0.3)(scene)) == [2, 3]
    assert selected(HalfSpace(2, below=0.5, above=0.1)(scene)) == [1, 2]
    assert selected(parse_half_space("y=1.5")(scene)) == [0, 1]
    assert selected(parse_half_space(" above  y = 1.5 ")(scene)) == [2, 3]


def test_near_points(scene: GaussianScene) -> None:
    points = torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.45]])
    assert selected(NearPoints(points, 0.1)(scene)) == [2]
    assert selected(NearPoints(points, 0.21)(scene)) == [1, 2]


def test_combinations(scene: GaussianScene) -> None:
    low, left = HalfSpace(2, below=0.3), HalfSpace(0, below=0.5)
    assert selected((low & left)(scene)) == [0]
    assert selected((low | left)(scene)) == [0, 1, 2]
    assert selected((~low)(scene)) == [2, 3]


def test_masks_are_applied_and_pins_stay_within_the_simulated(scene: GaussianScene) -> None:
    marked = apply_masks(scene, simulated=HalfSpace(0, below=0.5), pinned=HalfSpace(2, below=0.3))
    assert selected(marked.simulated) == [0, 2]
    assert selected(marked.pinned) == [0]
    assert selected(apply_masks(marked, foreground=marked.pinned).pinned) == [0]
    assert selected(apply_masks(marked, simulated=HalfSpace(2, above=0.3)).pinned) == []


def test_empty_selection_is_refused_with_the_extent(scene: GaussianScene) -> None:
    with pytest.raises(SceneError, match=r"'pinned'.*none of 4 kernels.*z 0\.\.0\.6"):
        apply_masks(scene, pinned=parse_half_space("z=-1"))


@pytest.mark.parametrize("text", ["0.33", "w=1", "left z=1", "z=", "z<1", "z=1.2.3"])
def test_half_space_of_another_form_is_refused(text: str) -> None:
    with pytest.raises(SceneError, match="AXIS=VALUE"):
        parse_half_space(text)


def test_what_nothing_holds_and_what_nothing_frees_is_refused(scene: GaussianScene) -> None:
    held = apply_masks(scene, pinned=parse_half_space("z=0.1"))
    assert require_pinned(held) is held
    with pytest.raises(SceneError, match="every simulated kernel is pinned"):
        require_pinned(dataclasses.replace(scene, pinned=scene.simulated))
    with pytest.raises(SceneError, match="mask 'simulated' marks no kernel"):
        require_pinned(dataclasses.replace(scene, simulated=scene.pinned))
    with pytest.raises(SceneError, match="no kernel is pinned") as caught:
        require_pinned(scene)
    proposed = re.findall(r"below z=[-.0-9e]+", str(caught.value))
    assert len(proposed) == 2  # one for either remedy
    assert {tuple(selected(parse_half_space(text)(scene))) for text in proposed} == {(0,)}
