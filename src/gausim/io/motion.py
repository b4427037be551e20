"""A motion as one GLB file: the rest scene as glTF, and twelve half floats per unit and frame.

Every kernel follows exactly one unit, x_k = x_c + G_c (X_k - X_c) with covariance G_c S_k G_c^T, so that the units'
centres and deformation gradients are the whole motion. A reader of glTF shows the rest scene with its base colours; the
motion is in ``extras.gausim_motion``, see docs/reference/files.md for the layout.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from msgspec import Meta, Struct
from torch import Tensor

from gausim.core import DataError, DivergenceError, GaussianScene, SceneError, Trajectory
from gausim.core.scene import SH_COEFFICIENTS
from gausim.io.files import write_durably
from gausim.io.gltf import Glb, read_glb, splat_glb, splat_scene
from gausim.io.plain_json import checked

KEY, VERSION, SUFFIX = "gausim_motion", 1, ".motion.glb"
# Kernels that leave the motion of their unit by more than this get a unit of their own [diagonals].
_FOLLOWS = 2e-4
# Levels of the stored spherical harmonics above degree 0, each way.
_LEVELS = 127
_MASKS = ("simulated", "pinned", "foreground")
_MOST_MEMORY = 8 << 30  # positions of all kernels and frames [bytes]
_REMEDY = "Export it again with `gausim export --format motion`."

_Count = Annotated[int, Meta(ge=1, le=1 << 31)]
_Size = Annotated[float, Meta(gt=0, le=1e30)]


class _Views(Struct, forbid_unknown_fields=True):
    """Indices of the buffer views."""

    rest_centres: int
    origins: int
    units: int
    unit_of_kernel: int
    masks: int
    sh: int


class _Facts(Struct, forbid_unknown_fields=True):
    """Facts of a motion, beside its arrays."""

    version: Literal[1]
    fps: _Size
    frames: _Count
    units: _Count
    diagonal: _Size  # unit of the stored lengths [scene units]
    volume_scale: _Size
    sh_scales: list[Annotated[float, Meta(ge=0, le=1e30)]]  # of every coefficient above degree 0
    views: _Views


@dataclass(frozen=True, eq=False)
class UnitMotion:
    """The motion of N units over F frames, and the unit that every kernel follows."""

    rest_centres: Float[Tensor, "N 3"]  # X_c, mean of the kernels of each unit at rest [scene units]
    displacements: Float[Tensor, "F N 3"]  # x_c - X_c of every frame [scene units]
    deformation_gradients: Float[Tensor, "F N 3 3"]  # G_c of every frame
    unit_of_kernel: Int[Tensor, " K"]  # the unit of each kernel

    @staticmethod
    def of(scene: GaussianScene, trajectory: Trajectory) -> UnitMotion:
        """The units' motion of a trajectory; a kernel that does not follow its unit becomes a unit of its own.

        Raises:
            DataError: the trajectory is of another scene.
            DivergenceError: a frame is not finite.
        """
        check_trajectory(scene, trajectory)
        positions, gradients = trajectory.positions.float(), trajectory.deformation_gradients.float()
        made = _averaged(scene.means, positions, gradients, trajectory.unit_of_kernel)
        leaves = torch.zeros(scene.count)
        for frame, now in zip(range(len(positions)), made.positions(scene.means), strict=True):
            leaves = torch.maximum(leaves, (now - positions[frame]).norm(dim=-1))
        alone = (leaves > _FOLLOWS * scene.diagonal).nonzero()[:, 0]
        if not len(alone):
            return made
        unit = trajectory.unit_of_kernel.clone()
        gradients = torch.cat((gradients, gradients[:, unit[alone]]), 1)
        unit[alone] = torch.arange(gradients.shape[1] - len(alone), gradients.shape[1])
        return _averaged(scene.means, positions, gradients, unit)

    def positions(self, rest: Float[Tensor, "K 3"]) -> Iterator[Float[Tensor, "K 3"]]:
        """x_c + G_c (X_k - X_c) of all kernels, frame by frame [scene units]; exactly X_k where nothing moves."""
        unit, offset = self.unit_of_kernel, (rest - self.rest_centres[self.unit_of_kernel])[..., None]
        for moved, gradients in zip(self.displacements, self.deformation_gradients - torch.eye(3), strict=True):
            yield rest + moved[unit] + (gradients[unit] @ offset)[..., 0]

    def trajectory(self, rest: Float[Tensor, "K 3"], fps: float) -> Trajectory:
        """The motion of all kernels; Q is the rotation of the polar decomposition of G."""
        left, _, right = torch.linalg.svd(self.deformation_gradients)
        left[..., 2] *= torch.linalg.det(left @ right)[..., None]
        positions = torch.stack(list(self.positions(rest)))
        return Trajectory(positions, self.deformation_gradients, left @ right, self.unit_of_kernel, fps)


def motion_glb(scene: GaussianScene, trajectory: Trajectory, *, up: str = "z") -> Glb:
    """The document of a motion, see :func:`save_motion`."""
    motion = UnitMotion.of(scene, trajectory)
    count, glb = len(motion.rest_centres), splat_glb(scene, up=up, degree=0)
    moved = motion.displacements
    # Half floats are relative: what all units have in common is stored apart where a body travels far.
    origins = (moved.amax(1) + moved.amin(1)) / 2
    if float(moved.abs().max()) < scene.diagonal:
        origins = torch.zeros_like(origins)
    parts = (moved - origins[:, None]) / scene.diagonal, (motion.deformation_gradients - torch.eye(3)).flatten(2)
    units = torch.cat(parts, 2).half().numpy().astype("<f2")
    if not np.isfinite(units).all():
        raise DataError(f"{scene.name}: the motion is beyond half floats (65504). Export it as ply or safetensors.")
    masks = sum(getattr(scene, name).cpu().int() << bit for bit, name in enumerate(_MASKS))
    high = scene.sh[:, 1:].detach().cpu().float()
    scales = high.abs().amax((0, 2)) / _LEVELS
    levels = (high / scales.clamp_min(1e-30)[:, None]).round()
    views = _Views(
        rest_centres=glb.add_view(motion.rest_centres.numpy().astype("<f4")),
        origins=glb.add_view(origins.numpy().astype("<f4")),
        units=glb.add_view(units),
        unit_of_kernel=glb.add_view(motion.unit_of_kernel.numpy().astype("<u2" if count <= 1 << 16 else "<u4")),
        masks=glb.add_view(np.asarray(masks, np.uint8)),
        sh=glb.add_view(levels.numpy().astype(np.int8)),
    )
    facts = _Facts(
        1, trajectory.fps, trajectory.frames, count, scene.diagonal, scene.volume_scale, scales.tolist(), views
    )
    glb.document["extras"] = {KEY: msgspec.to_builtins(facts)}
    return glb


def save_motion(path: Path | str, scene: GaussianScene, trajectory: Trajectory, *, up: str = "z") -> None:
    """Writes a rest scene and its motion; replaces the file atomically. ``up`` (y or z) is for readers of glTF.

    Kept: the rest scene (float32; spherical harmonics above degree 0 with 8 bits), its masks, every unit's centre
    and deformation gradient with 11 significant bits. Lost: rotations, which on reading are those of the
    deformation gradients.

    Raises:
        DataError: the trajectory is of another scene, or goes beyond half floats or the size of a GLB.
        DivergenceError: a frame is not finite.
    """
    write_durably(Path(path), motion_glb(scene, trajectory, up=up).to_bytes())


def load_motion(path: Path | str) -> tuple[GaussianScene, Trajectory]:
    """Reads a rest scene and its motion.

    Raises:
        DataError: the file is missing, damaged, has no motion, or one of another version; names the field.
    """
    path = Path(path)
    glb = read_glb(path)
    facts = _facts(glb)
    scene = _scene(glb, facts, path)
    views, frames, units = facts.views, facts.frames, facts.units
    needs = frames * scene.count * 12
    if needs > _MOST_MEMORY:
        raise DataError(
            f"{path}: {frames} frames of {scene.count} kernels take {needs / 2**30:.1f} GiB, expected at most "
            f"{_MOST_MEMORY >> 30}. Export fewer frames (--every)."
        )
    rest = _array(glb, views.rest_centres, "rest_centres", "<f4", (units, 3)).copy()
    origins = _array(glb, views.origins, "origins", "<f4", (frames, 3))
    moved = _array(glb, views.units, "units", "<f2", (frames, units, 12)).astype(np.float32)
    kind = "<u2" if units <= 1 << 16 else "<u4"
    index = _array(glb, views.unit_of_kernel, "unit_of_kernel", kind, (scene.count,)).astype(np.int64)
    if index.max() >= units:
        raise DataError(f"{path}: field 'unit_of_kernel': expected indices of {units} units. {_REMEDY}")
    gradients = np.eye(3, dtype=np.float32) + moved[..., 3:].reshape(frames, units, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        shifts = origins[:, None] + np.float32(facts.diagonal) * moved[..., :3]
    motion = UnitMotion(*(torch.from_numpy(np.ascontiguousarray(x)) for x in (rest, shifts, gradients, index)))
    trajectory = motion.trajectory(scene.means, facts.fps)
    if not torch.isfinite(trajectory.positions).all():
        raise DataError(f"{path}: fields 'units' and 'diagonal' give positions beyond float32. {_REMEDY}")
    return scene, trajectory


def _facts(glb: Glb) -> _Facts:
    extras = glb.document.get("extras")
    plain = extras.get(KEY) if isinstance(extras, dict) else None
    if plain is None:
        raise DataError(f"{glb.source}: has no 'extras.{KEY}', so it holds no motion of gausim. {_REMEDY}")
    version = plain.get("version") if isinstance(plain, dict) else None
    if version != VERSION:
        raise DataError(
            f"{glb.source}: field 'version': expected {VERSION}, got {str(version)[:40]}. Read it with the gausim that "
            "wrote it, or update gausim."
        )
    return checked(plain, _Facts, f"{glb.source}: extras.{KEY}", _REMEDY)


def _scene(glb: Glb, facts: _Facts, path: Path) -> GaussianScene:
    scene = splat_scene(glb, path.name.removesuffix(SUFFIX))
    count, above = scene.count, len(facts.sh_scales)
    if above + 1 not in SH_COEFFICIENTS.values() or scene.sh.shape[1] != 1:
        raise DataError(f"{path}: field 'sh_scales': expected 0, 3, 8 or 15 numbers, got {above}. {_REMEDY}")
    levels = _array(glb, facts.views.sh, "sh", "i1", (count, above, 3)).astype(np.float32)
    high = torch.from_numpy(levels * np.asarray(facts.sh_scales, np.float32)[:, None])
    bits = torch.from_numpy(_array(glb, facts.views.masks, "masks", "u1", (count,)).astype(np.int64))
    masks: dict[str, Any] = {name: (bits >> bit & 1).bool() for bit, name in enumerate(_MASKS)}
    try:
        return replace(
            scene, sh=torch.cat((scene.sh, high), 1), volume_scale=facts.volume_scale, **masks
        ).validated()  # fmt: skip
    except SceneError as error:
        raise DataError(f"{path}: {error} {_REMEDY}") from error


def _array(glb: Glb, index: int, name: str, kind: str, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of a buffer view, finite."""
    data, dtype = glb.view(index, name), np.dtype(kind)
    expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if len(data) != expected:
        raise DataError(
            f"{glb.source}: field '{name}': expected {expected} bytes for {dtype} {shape}, got {len(data)}. {_REMEDY}"
        )
    array = np.frombuffer(data, dtype).reshape(shape)
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise DataError(f"{glb.source}: field '{name}' is NaN or infinite. {_REMEDY}")
    return array


def _averaged(rest: Tensor, positions: Tensor, gradients: Tensor, unit: Tensor) -> UnitMotion:
    """Units' centres and displacements as means over their kernels; zero for units without kernels."""
    count = gradients.shape[1]
    members = torch.zeros(count).index_add(0, unit, torch.ones(len(unit))).clamp_min(1)[:, None]
    centres = torch.zeros(count, 3, dtype=torch.float64).index_add(0, unit, rest.double()) / members
    # x_c - X_c = mean of x_k - X_k, since the offsets of a unit's kernels from their mean sum to zero.
    moved = torch.zeros(len(positions), count, 3, dtype=torch.float64)
    for frame, now in zip(moved, positions, strict=True):
        frame.index_add_(0, unit, now.double() - rest.double())
    return UnitMotion(centres.float(), (moved / members).float(), gradients, unit)


def check_trajectory(scene: GaussianScene, trajectory: Trajectory) -> None:
    """Checks that a trajectory can be exported with a scene.

    Raises:
        DataError: it is of another scene.
        DivergenceError: a frame is not finite.
    """
    if trajectory.positions.shape[1] != scene.count:
        raise DataError(
            f"{scene.name}: has {scene.count} kernels, the trajectory {trajectory.positions.shape[1]}. Give the scene "
            "that it was made with."
        )
    for values in (trajectory.positions, trajectory.deformation_gradients):
        bad = ~torch.isfinite(values).reshape(trajectory.frames, -1).all(-1)
        if bool(bad.any()):
            raise DivergenceError(f"{scene.name}: frame {int(bad.nonzero()[0])} is not finite; it cannot be shown.")
