"""Moving Gaussians as OpenUSD: one ParticleField3DGaussianSplat with a time sample per frame (usd-core >= 26.3).

Stored in float32: positions, orientations, scales, opacities, spherical harmonics. The schema has no masks.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gausim.core import ConfigError, DataError, GaussianScene
from gausim.io.files import replacing

SUFFIXES = (".usd", ".usda", ".usdc")
PRIM = "/Splats"


def contiguous(values: torch.Tensor) -> np.ndarray:
    """The values in float32, row by row."""
    return np.ascontiguousarray(values.detach().cpu().float().numpy())


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


def _pxr() -> Any:
    try:
        import pxr
        from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol, Vt  # noqa: F401
    except ImportError as error:
        raise ConfigError("OpenUSD is not installed. Install it with `pip install gausim[usd]`.") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise ConfigError("usd-core: expected 26.3 or newer, which knows Gaussians. `pip install -U usd-core`.")
    return pxr
