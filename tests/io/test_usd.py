"""Moving Gaussians as OpenUSD, as usd-core reads them."""

from pathlib import Path

import numpy as np
import pytest
from helpers.plain import random_scene, unit_motion

from gausim.core import ConfigError, DataError, GaussianScene
from gausim.io.usd import save_usd
from gausim.ops.deformed_scene import deformed_scene

pxr = pytest.importorskip("pxr", reason="needs usd-core (extra usd)")


def motion(rest: GaussianScene, frames: int = 4) -> list[GaussianScene]:
    made = unit_motion(rest, frames)
    states = zip(made.positions, made.deformation_gradients, made.rotations, strict=True)
    return [deformed_scene(rest, *state, made.unit_of_kernel) for state in states]


def test_what_others_read(tmp_path: Path) -> None:
    """The attributes of the schema, as its documentation has them."""
    from pxr import Usd, UsdGeom

    frames = motion(random_scene(40, 2))
    save_usd(tmp_path / "m.usdc", frames, 24.0)
    assert [path.name for path in tmp_path.iterdir()] == ["m.usdc"]
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 3, 24)
    quat = prim.GetAttribute("orientations").Get(2)[7]
    expected = frames[2].quats[7] / frames[2].quats[7].norm()
    assert np.allclose([quat.GetReal(), *quat.GetImaginary()], expected, atol=1e-6)
    positions = prim.GetAttribute("positions")
    assert positions.GetTimeSamples() == [0, 1, 2, 3] and np.array_equal(positions.Get(2), frames[2].means.numpy())
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(1)) == 40 * 9
    low, high = np.array(prim.GetAttribute("extent").Get(1))
    assert (low < frames[1].means.amin(0).numpy()).all() and (high > frames[1].means.amax(0).numpy()).all()
    save_usd(tmp_path / "still.usda", [frames[0]] * 3, 24.0)
    still = Usd.Stage.Open(str(tmp_path / "still.usda"))
    assert len(still.GetDefaultPrim().GetAttribute("radiance:sphericalHarmonicsCoefficients").GetTimeSamples()) == 1


def test_names_and_sizes_are_checked(tmp_path: Path) -> None:
    frames = motion(random_scene(40, 2))
    with pytest.raises(ConfigError, match=".usdc, and up y or z, got up x"):
        save_usd(tmp_path / "m.usdc", frames, 24.0, up="x")
    with pytest.raises(ConfigError, match="ends in .usd"):
        save_usd(tmp_path / "m.usdz", frames, 24.0)
    with pytest.raises(DataError, match="no frames to write"):
        save_usd(tmp_path / "m.usdc", [], 24.0)
    with pytest.raises(DataError, match="frame 1 has 7 Gaussians, expected 40"):
        save_usd(tmp_path / "m.usdc", [frames[0], random_scene(7, 2)], 24.0)
    assert list(tmp_path.iterdir()) == []
