"""Moving Gaussians as OpenUSD and back: equal within float32, and broken files are refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.random_scene import random_scene
from helpers.unit_motions import unit_motion

from gausim.core import ConfigError, DataError, GaussianScene
from gausim.io import usd
from gausim.io.usd import load_usd, save_usd
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.deformed_scene import deformed_scene

pxr = pytest.importorskip("pxr", reason="needs usd-core (extra usd)")


def motion(rest: GaussianScene, frames: int = 4) -> list[GaussianScene]:
    made = unit_motion(rest, frames)
    states = zip(made.positions, made.deformation_gradients, made.rotations, strict=True)
    return [deformed_scene(rest, *state, made.unit_of_kernel) for state in states]


@pytest.mark.parametrize(("suffix", "degree"), [(".usda", 0), (".usdc", 3), (".usd", 1)])
def test_round_trip(tmp_path: Path, suffix: str, degree: int) -> None:
    frames = motion(random_scene(40, degree, masks=False))
    path = tmp_path / f"m{suffix}"
    assert save_usd(path, iter(frames), 23.976, up="y") == 4
    clip = load_usd(path)
    assert clip.frames == 4 and clip.fps == pytest.approx(23.976, abs=1e-9) and clip.up == "y"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    for made, read in zip(frames, clip.scenes(), strict=True):
        assert torch.equal(read.means, made.means) and torch.equal(read.sh, made.sh)
        S, T = (covariance_from_scales(s.log_scales.double(), s.quats.double()) for s in (made, read))
        assert float((S - T).norm(dim=(-1, -2)).div(S.norm(dim=(-1, -2))).max()) < 2e-6
        assert torch.allclose(torch.sigmoid(read.opacity_logits), torch.sigmoid(made.opacity_logits), atol=1e-6)


def test_what_others_read(tmp_path: Path) -> None:
    """The attributes of the schema, as its documentation has them."""
    from pxr import Usd, UsdGeom

    frames = motion(random_scene(40, 2))
    save_usd(tmp_path / "m.usdc", frames, 24.0)
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 3, 24)
    quat = prim.GetAttribute("orientations").Get(2)[7]
    expected = frames[2].quats[7] / frames[2].quats[7].norm()
    assert np.allclose([quat.GetReal(), *quat.GetImaginary()], expected, atol=1e-6)
    assert prim.GetAttribute("positions").GetTimeSamples() == [0, 1, 2, 3]
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(1)) == 40 * 9
    low, high = np.array(prim.GetAttribute("extent").Get(1))
    assert (low < frames[1].means.amin(0).numpy()).all() and (high > frames[1].means.amax(0).numpy()).all()
    save_usd(tmp_path / "still.usda", [frames[0]] * 3, 24.0)
    still = Usd.Stage.Open(str(tmp_path / "still.usda"))
    assert len(still.GetDefaultPrim().GetAttribute("radiance:sphericalHarmonicsCoefficients").GetTimeSamples()) == 1
    assert [torch.equal(s.sh, frames[0].sh) for s in load_usd(tmp_path / "still.usda").scenes()] == [True] * 3


TEXT = """#usda 1.0
( {header} )
def ParticleField3DGaussianSplat "S" {{
  point3f[] positions.timeSamples = {{ 0: [(0,0,0), (1,0,0)], {second} }}
  float3[] scales = [{scale}, (1,1,1)]
  quatf[] orientations = [{quat}, (1,0,0,0)]
  float[] opacities = [{opacity}]
  int radiance:sphericalHarmonicsDegree = {degree}
  float3[] radiance:sphericalHarmonicsCoefficients = [(1,1,1), (0,0,0)]
}}
{after}
"""
GOOD = {"header": "timeCodesPerSecond = 30", "second": "1: [(0,0,1), (1,0,1)]", "scale": "(1,1,1)", "quat": "(1,0,0,0)",
        "opacity": "0.5, 1", "degree": "0", "after": ""}  # fmt: skip


def test_a_file_of_others_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(TEXT.format(**GOOD))
    clip = load_usd(tmp_path / "a.usda")
    first, second = clip.scenes()
    assert clip.fps == 30 and second.means.tolist() == [[0, 0, 1], [1, 0, 1]]
    assert float(first.opacity_logits[0]) == 0 and torch.isfinite(first.opacity_logits).all()
    (tmp_path / "b.usda").write_text(TEXT.format(**GOOD | {"second": "2: [(0,0,1), (1,0,1)]"}))
    assert load_usd(tmp_path / "b.usda").fps == 15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"second": "1: [(0,0,1)]"}, "frame 1: attribute 'radiance:spherical.*' has 2 values, expected 1"),
        ({"second": "1: [(0,0,nan), (1,0,1)]"}, "frame 1: attribute 'positions' is NaN or infinite"),
        ({"second": "1: [(0,0,1), (1,0,1)], 5: [(0,0,1), (1,0,1)]"}, "at equal distances"),
        ({"scale": "(1,0,1)"}, "attributes 'scales'"),
        ({"scale": "(1,inf,1)"}, "'scales' is NaN or infinite"),
        ({"quat": "(0,0,0,0)"}, "'orientations': expected quaternions that are not zero"),
        ({"opacity": "0.5, 1.5"}, "'opacities'"),
        ({"opacity": "0.5"}, "'opacities' has 1 values, expected 2"),
        ({"degree": "9"}, "'radiance:sphericalHarmonicsDegree': expected 0..3, got 9"),
        ({"degree": "1"}, "'radiance:sphericalHarmonicsCoefficients' has 2 values, expected 8"),
        ({"header": "timeCodesPerSecond = -3"}, "timeCodesPerSecond"),
        ({"header": "subLayers = [@/etc/passwd@]"}, "refers to other files"),
        ({"after": 'def "T" ( references = @../../secret.usda@ ) { }'}, "refers to other files"),
        ({"after": 'def "T" ( payload = @x.usda@ ) { }'}, "refers to other files"),
        ({"after": 'def ParticleField3DGaussianSplat "T" { }'}, "has 2 prims"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, change: dict[str, str], message: str) -> None:
    (tmp_path / "bad.usda").write_text(TEXT.format(**GOOD | change))
    with pytest.raises(DataError, match=f"bad.usda: .*{message}|bad.usda: {message}"):
        list(load_usd(tmp_path / "bad.usda").scenes())


def test_what_is_no_usd_is_refused(tmp_path: Path) -> None:
    save_usd(tmp_path / "m.usdc", motion(random_scene(40, 2)), 24.0)
    whole = (tmp_path / "m.usdc").read_bytes()
    for number, content in enumerate((b"", b"#usda 1.0\ndef {", b"PXR-USDC" + bytes(80), whole[:200], whole[:-50])):
        path = tmp_path / f"bad_{number}.usd"
        path.write_bytes(content)
        with pytest.raises(DataError, match=path.name):
            load_usd(path)


def test_names_and_sizes_are_checked(tmp_path: Path, monkeypatch) -> None:
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
    with pytest.raises(DataError, match="no such file"):
        load_usd(tmp_path / "none.usd")
    save_usd(tmp_path / "m.usdc", frames, 24.0)
    monkeypatch.setattr(usd, "_LARGEST", 10)
    with pytest.raises(DataError, match="expected at most"):
        load_usd(tmp_path / "m.usdc")
