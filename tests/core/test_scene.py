"""Scenes with wrong kernels, and the two positions of a state."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.toy_object import toy_scene

from gausim.cli.main import main
from gausim.core import GaussianScene, SceneError
from gausim.core.outliers import outliers, without_outliers
from gausim.core.state import initial_sway
from gausim.io.ply import load_scene, save_scene


def test_sway_grows_from_the_roots() -> None:
    scene = toy_scene()
    state = initial_sway(scene, 0.01)
    shift = (state.positions - state.previous)[:, 0]
    assert (shift[scene.pinned] == 0).all() and (shift[~scene.pinned] > 0).all()
    assert float(shift.max()) == pytest.approx(0.01 * scene.diagonal, rel=1e-5)
    assert torch.equal(state.positions, scene.means)


def body(count: int = 60) -> GaussianScene:
    torch.manual_seed(0)
    return GaussianScene.create(
        means=torch.rand(count, 3), log_scales=torch.full((count, 3), -3.0), quats=torch.ones(count, 4),
        opacity_logits=torch.zeros(count), sh=torch.zeros(count, 1, 3),
    )  # fmt: skip


def with_kernel(number: int, **changes: float) -> GaussianScene:
    scene = body()
    for name, value in changes.items():
        getattr(scene, name)[number] = value
    return scene


@pytest.mark.parametrize(("changes", "told"), [
    ({"means": 1e5}, "1 of 60 kernels are outside of the body"),
    ({"means": -40.0}, "1 of 60 kernels are outside of the body"),
    ({"log_scales": 80.0}, "1 of 60 kernels are larger than the body"),
    ({"log_scales": 200.0}, "1 of 60 kernels are larger than the body"),
    ({"log_scales": 1.0}, "1 of 60 kernels are larger than the body"),
])  # fmt: skip
def test_a_wrong_kernel_is_named_and_left_out(tmp_path: Path, caplog, capsys, changes, told: str) -> None:
    save_scene(with_kernel(7, **changes), tmp_path / "a.ply", masks=False)
    with caplog.at_level(logging.WARNING):
        scene = load_scene(tmp_path / "a.ply")
    assert told in caplog.text and "first: number 7" in caplog.text and "--clean" in caplog.text
    assert main(["inspect", str(tmp_path / "a.ply"), "--clean", str(tmp_path / "b.ply")]) == 0
    assert "59 of 60 kernels" in capsys.readouterr().out
    caplog.clear()
    clean = load_scene(tmp_path / "b.ply")
    assert not caplog.text and clean.count == 59 and clean.diagonal < 2
    torch.testing.assert_close(clean.means, torch.cat([scene.means[:7], scene.means[8:]]))
    assert clean.volume_scale == pytest.approx(body().volume_scale)


@pytest.mark.parametrize("scale", [0.01, 0.2, 1.5])
def test_scales_without_the_logarithm_are_named(scale: float) -> None:
    scene = replace(body(), log_scales=torch.full((60, 3), scale))
    (found,) = outliers(scene)
    assert "without the logarithm" in found.what
    with pytest.raises(SceneError, match="no kernel is sound"):
        without_outliers(scene)


@pytest.mark.parametrize(
    ("opacity", "told"), [((0, 1), True), ((-3, 4), False), ((0.4, 0.6), False), ((0, 1.2), False)]
)
def test_opacities_without_the_logit_are_named(opacity: tuple[float, float], told: bool, tmp_path, caplog) -> None:
    scene = replace(body(), opacity_logits=torch.linspace(*opacity, 60))
    save_scene(scene, tmp_path / "a.ply")
    with caplog.at_level(logging.WARNING):
        load_scene(tmp_path / "a.ply")
    assert ("without the logit" in caplog.text) is told and "--clean" not in caplog.text


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_sound_scene_has_none_in_any_unit(unit: float) -> None:
    scene = body()
    scaled = replace(scene, means=scene.means * unit, log_scales=scene.log_scales + torch.tensor(unit).log())
    assert outliers(scaled) == [] and without_outliers(scaled).count == 60
    sky = with_kernel(3, log_scales=80.0)
    sky.simulated[3] = False
    assert outliers(sky) == []
