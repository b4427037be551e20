"""Moving Gaussians as OpenUSD: one ParticleField3DGaussianSplat with a time sample per frame (usd-core >= 26.3).

Stored in float32: positions, orientations, scales, opacities, spherical harmonics. The schema has no masks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gausim.core import ConfigError, DataError, GaussianScene
from gausim.core.scene import SH_COEFFICIENTS
from gausim.io.files import replacing
from gausim.io.gltf import contiguous, linear_scene

SUFFIXES = (".usd", ".usda", ".usdc")
PRIM = "/Splats"
_LARGEST, _MOST_FRAMES = 8 << 30, 100_000


@dataclass(frozen=True, eq=False)
class UsdClip:
    """Reader of the moving Gaussians of a file, frame by frame."""

    path: Path  # the file
    fps: float  # frames per second
    frames: int  # number of frames
    up: str  # vertical axis, ``y`` or ``z``
    stage: Any  # the open stage
    splats: Any  # the ParticleField3DGaussianSplat of the stage
    times: tuple[float, ...]  # time code of every frame

    def scenes(self) -> Iterator[GaussianScene]:
        """The frames, one at a time; masks are the defaults (all simulated, none pinned).

        Raises:
            DataError: an attribute is missing, out of range or differs in length from the others; names it.
        """
        count = None
        for number, time in enumerate(self.times):
            scene = _scene(self, time, f"{self.path}: frame {number}")
            count = scene.count if count is None else count
            if scene.count != count:
                raise DataError(
                    f"{self.path}: frame {number}: attribute 'positions' has {scene.count} Gaussians, expected {count}."
                )
            yield scene


def save_usd(path: Path | str, frames: Iterable[GaussianScene], fps: float, *, up: str = "z") -> int:
    """Writes moving Gaussians of equal number, atomically; returns the number of frames. Frame n has time code n.

    Files named .usd and .usdc are binary, .usda is text; the vertical axis ``up`` is y or z.

    Raises:
        ConfigError: usd-core is not installed, or the suffix or axis is not supported.
        DataError: there are no frames, or they differ in size.
    """
    pxr, path = _pxr(), Path(path)
    if path.suffix not in SUFFIXES or up not in ("y", "z"):
        raise ConfigError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}, and up y or z, got up {up}.")
    with replacing(path, typed=True) as temporary:
        stage = pxr.Usd.Stage.CreateNew(str(temporary))
        count = _write(pxr, stage, frames, path)
        stage.SetFramesPerSecond(fps)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(count - 1)
        pxr.UsdGeom.SetStageUpAxis(stage, up.upper())
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.GetRootLayer().Save()
    return count


def load_usd(path: Path | str) -> UsdClip:
    """Opens moving Gaussians.

    Raises:
        ConfigError: usd-core is not installed.
        DataError: the file is missing, is not USD, refers to other files, or does not contain exactly one
            ParticleField3DGaussianSplat with a valid frame rate.
    """
    pxr, path = _pxr(), Path(path)
    if path.suffix not in SUFFIXES or not path.is_file():
        raise DataError(f"{path}: no such file, or its name does not end in one of {', '.join(SUFFIXES)}.")
    if path.stat().st_size > _LARGEST:
        raise DataError(f"{path}: expected at most {_LARGEST >> 30} GiB, got {path.stat().st_size} bytes.")
    try:
        layer = pxr.Sdf.Layer.OpenAsAnonymous(str(path))
    except pxr.Tf.ErrorException as error:
        raise DataError(f"{path}: cannot be read as USD ({str(error).strip()[-200:]}). Export it again.") from error
    if layer is None:
        raise DataError(f"{path}: cannot be read as USD. Export it again.")
    # Files to which the stage refers are not opened: they could be any file of this machine.
    if layer.GetCompositionAssetDependencies():
        raise DataError(f"{path}: refers to other files; expected one that holds all by itself. Flatten it first.")
    stage = pxr.Usd.Stage.Open(layer)
    found = [prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    if len(found) != 1:
        raise DataError(f"{path}: has {len(found)} prims ParticleField3DGaussianSplat, expected one.")
    splats = pxr.UsdVol.ParticleField3DGaussianSplat(found[0])
    times = tuple(splats.GetPositionsAttr().GetTimeSamples()) or (0.0,)
    fps = float(stage.GetTimeCodesPerSecond())
    steps = np.diff(times)
    if len(times) > _MOST_FRAMES or not np.isfinite(times).all() or (len(steps) and not np.allclose(steps, steps[0])):
        raise DataError(f"{path}: attribute 'positions': expected at most {_MOST_FRAMES} samples at equal distances.")
    rate = fps / float(steps[0]) if len(steps) else fps
    if not (math.isfinite(rate) and rate > 0):
        raise DataError(f"{path}: field 'timeCodesPerSecond' is {fps}, expected a number > 0.")
    up = str(pxr.UsdGeom.GetStageUpAxis(stage)).lower()
    return UsdClip(path, rate, len(times), up, stage, splats, times)


def _write(pxr: Any, stage: Any, frames: Iterable[GaussianScene], path: Path) -> int:
    vt, count, first = pxr.Vt, 0, None
    splats = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    stage.SetDefaultPrim(splats.GetPrim())
    positions, orientations = splats.CreatePositionsAttr(), splats.CreateOrientationsAttr()
    scales, extent = splats.CreateScalesAttr(), splats.CreateExtentAttr()
    sh, last_sh = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(), None
    for count, scene in enumerate(frames, start=1):
        if first is None:
            first = scene
            splats.CreateRadianceSphericalHarmonicsDegreeAttr(scene.sh_degree)
            splats.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(contiguous(torch.sigmoid(scene.opacity_logits))))
        if scene.count != first.count or scene.sh.shape != first.sh.shape:
            raise DataError(f"{path}: frame {count - 1} has {scene.count} Gaussians, expected {first.count}.")
        time, means, lengths = count - 1, contiguous(scene.means), contiguous(scene.log_scales.exp())
        quats = contiguous(scene.quats / scene.quats.norm(dim=-1, keepdim=True))
        positions.Set(vt.Vec3fArray.FromNumpy(means), time)
        # Vt stores the imaginary parts first.
        orientations.Set(vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats[:, [1, 2, 3, 0]])), time)
        scales.Set(vt.Vec3fArray.FromNumpy(lengths), time)
        reach = 3 * lengths.max(-1, keepdims=True)
        box = np.stack([(means - reach).min(0), (means + reach).max(0)]).astype(np.float32)
        extent.Set(vt.Vec3fArray.FromNumpy(box), time)
        # Constant colours are written once.
        if last_sh is None or not torch.equal(last_sh, scene.sh):
            sh.Set(vt.Vec3fArray.FromNumpy(contiguous(scene.sh).reshape(-1, 3)), time)
            last_sh = scene.sh
    if first is None:
        raise DataError(f"{path}: no frames to write; a clip needs at least one.")
    return count


def _scene(clip: UsdClip, time: float, source: str) -> GaussianScene:
    splats = clip.splats
    means = _array(splats.GetPositionsAttr(), time, source, width=3)
    count = len(means)
    degree = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    if degree not in SH_COEFFICIENTS:
        raise DataError(f"{source}: attribute 'radiance:sphericalHarmonicsDegree': expected 0..3, got {degree}.")
    basis = SH_COEFFICIENTS[degree]
    held = _array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr(), time, source, width=3, count=count * basis)
    scales = _array(splats.GetScalesAttr(), time, source, width=3, count=count)
    quats = _array(splats.GetOrientationsAttr(), time, source, width=4, count=count)
    opacities = _array(splats.GetOpacitiesAttr(), time, source, width=1, count=count)[:, 0]
    if not (scales > 0).all() or not ((opacities >= 0) & (opacities <= 1)).all():
        raise DataError(f"{source}: attributes 'scales' and 'opacities': expected values > 0 and in 0..1.")
    if not np.linalg.norm(quats, axis=-1).all():
        raise DataError(f"{source}: attribute 'orientations': expected quaternions that are not zero.")
    return linear_scene(means, scales, quats, opacities, held.reshape(count, basis, 3), clip.path.stem)


def _array(attribute: Any, time: float, source: str, *, width: int, count: int | None = None) -> np.ndarray:
    """Values of an attribute at a time code, (count, width) float32, or those of the sample before it."""
    name = attribute.GetName()
    samples = attribute.GetTimeSamples()
    held = max((t for t in samples if t <= time), default=samples[0] if samples else None)
    value = attribute.Get() if held is None else attribute.Get(held)
    try:
        numbers = np.array(value, dtype=np.float32).reshape(-1, width) if value is not None else np.zeros((0, width))
    except (TypeError, ValueError) as error:
        raise DataError(f"{source}: attribute '{name}' has another type than in the schema ({error}).") from error
    if len(numbers) == 0 or (count is not None and len(numbers) != count):
        expected = "some" if count is None else str(count)
        raise DataError(f"{source}: attribute '{name}' has {len(numbers)} values, expected {expected}.")
    if not np.isfinite(numbers).all():
        raise DataError(f"{source}: attribute '{name}' is NaN or infinite. Export it again.")
    return numbers.astype(np.float32)


def _pxr() -> Any:
    try:
        import pxr
        from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol, Vt  # noqa: F401
    except ImportError as error:
        raise ConfigError("OpenUSD is not installed. Install it with `pip install gausim[usd]`.") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise ConfigError("usd-core: expected 26.3 or newer, which knows Gaussians. `pip install -U usd-core`.")
    return pxr
