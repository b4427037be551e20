"""Surroundings of an object as its data set states them: ``dataset.json`` and ``hands.npz``."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from msgspec import Meta, Struct
from scipy.spatial import cKDTree

from gausim.core import DataError, Floor, GaussianScene, HandPath, Surroundings
from gausim.io.npz import read_array
from gausim.io.plain_json import checked

HANDS = "hands.npz"
Vector = tuple[float, float, float]


class _Floor(Struct, forbid_unknown_fields=True):
    point: Vector
    normal: Vector
    friction: Annotated[float, Meta(ge=0)] | None = None
    restitution: Annotated[float, Meta(ge=0, le=1)] | None = None


class _Facts(Struct):
    gravity: Vector | Literal["trained"] | None = None
    floor: _Floor | None = None
    free: bool = False
    grip: Annotated[float, Meta(gt=0)] | None = None


def read_surroundings(facts: object, where: str) -> tuple[Surroundings, float | None]:
    """Surroundings, and the reach of the hands' grip [scene units], that ``dataset.json`` states.

    Raises:
        DataError: a field is malformed; names the file ``where`` and the field.
    """
    found = checked(facts, _Facts, where, "Correct the field.")
    floor = None
    if found.floor is not None:
        normal = torch.tensor(found.floor.normal, dtype=torch.float64)
        if not bool(torch.isfinite(normal).all()) or float(normal.norm()) < 1e-9:
            raise DataError(
                f"{where}: field 'floor.normal' is {found.floor.normal}; expected a vector that is not zero."
            )
        x, y, z = (normal / normal.norm()).tolist()
        floor = Floor(found.floor.point, (x, y, z), found.floor.friction, found.floor.restitution)
    trains = found.gravity == "trained"
    gravity = None if isinstance(found.gravity, str) else found.gravity
    return Surroundings(found.free, gravity, trains, floor), found.grip


def read_hands(folder: Path, frames: int) -> tuple[HandPath, torch.Tensor, torch.Tensor] | None:
    """Path of the hands of a sequence, their points at frame 0 (C, 3) and the hand of each; None without hands.

    Raises:
        DataError: an array is missing, malformed, or has another number of frames than the sequence.
    """
    path = folder / HANDS
    if not path.is_file():
        return None
    points, hand = (torch.from_numpy(read_array(path, name)) for name in ("points", "hand"))
    if points.ndim != 3 or points.shape[0] != frames or points.shape[2] != 3 or not points.shape[1]:
        raise DataError(f"{path}: array 'points' is of shape {tuple(points.shape)}, expected ({frames}, C, 3).")
    if not points.is_floating_point():
        raise DataError(f"{path}: array 'points' must hold floating-point numbers, got {points.dtype}.")
    if hand.shape != points.shape[1:2] or hand.is_floating_point():
        raise DataError(
            f"{path}: array 'hand' is {hand.dtype} {tuple(hand.shape)}, expected whole numbers ({points.shape[1]},)."
        )
    hand, count = hand.long(), int(hand.max()) + 1
    if int(hand.min()) < 0 or len(hand.unique()) != count:
        raise DataError(f"{path}: array 'hand' has {sorted(set(hand.tolist()))[:8]}; expected 0..G-1, each of them.")
    return HandPath.of(points, hand), points[0].float(), hand


def gripped(
    scene: GaussianScene, points: torch.Tensor, hand: torch.Tensor, reach: float | None, where: str
) -> GaussianScene:
    """The scene with its hands: kernels within ``reach`` of a hand's point (C, 3) are pinned to that hand.

    Raises:
        DataError: a hand holds no kernel, or none is left that moves by itself.
    """
    distance, nearest = cKDTree(points.numpy()).query(scene.means.cpu().numpy())
    near = torch.from_numpy(distance <= (reach or 0.0)).to(scene.pinned.device) & scene.simulated
    holder = hand[torch.from_numpy(nearest)].to(scene.pinned.device)
    held = torch.where(near, holder, -1)
    empty = sorted(set(hand.tolist()) - set(held.tolist()))
    if empty:
        raise DataError(
            f"{where}: field 'grip' is {reach}: hand {empty[0]} holds none of the "
            f"{int(scene.simulated.sum())} simulated kernels. Raise it to the distance [scene units] from the "
            "hands' points to the object."
        )
    pinned = scene.pinned | near
    if not (scene.simulated & ~pinned).any():
        raise DataError(
            f"{where}: field 'grip' is {reach}: no simulated kernel is left outside the hands. Lower it to the "
            "distance [scene units] within which the hands' points hold the object."
        )
    return replace(scene, pinned=pinned, hand=held)
