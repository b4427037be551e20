"""The Gaussians of READY's and PhysDreamer's folders, and the point clouds and lists that mark parts of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gausim.core.errors import DataError, SceneError
from gausim.io.plain_json import read_any_json

SCENE, MOVING, OBJECT, PINS = "point_cloud.ply", "moving_part_points.ply", "clean_object_points.ply", "pin_mask.json"


def scene_files(root: Path) -> dict[str, Path]:
    """The files of the scene that are there, by name."""
    return {name: root / name for name in (SCENE, MOVING, OBJECT, PINS) if (root / name).is_file()}


def read_pins(path: Path, count: int) -> np.ndarray:
    """(count,) bool of ``pin_mask.json``: a list of kernel numbers, or of one truth value per kernel.

    The list may stand alone or as the only list of an object.
    """
    data = read_any_json(path)
    if isinstance(data, dict):
        lists = [value for value in data.values() if isinstance(value, list)]
        data = lists[0] if len(lists) == 1 else None
    if not isinstance(data, list) or not data:
        raise DataError(f"{path}: expected a list of kernel numbers.")
    if all(isinstance(v, bool) for v in data) and len(data) == count:
        return np.array(data)
    wrong = [v for v in data if isinstance(v, bool) or not isinstance(v, int) or not 0 <= v < count]
    if wrong:
        raise DataError(f"{path}: '{wrong[0]!r:.40}' is no kernel; expected whole numbers from 0 to {count - 1}.")
    pins = np.zeros(count, bool)
    pins[data] = True
    return pins


def write_scene(work: Path, root: Path, near: float, *, anchor: float | None = None) -> dict[str, int] | None:
    """Writes ``scene.ply`` with its masks, where there is a point cloud, and returns how many kernels they mark.

    Args:
        work: folder to write to.
        root: folder of the authors' files.
        near: distance to a cloud within which kernels belong to it [scene units].
        anchor: kernels of the object this near to the moving ones, but not moving, are simulated and pinned
            [scene units]; None: the pins are those of the list.
    """
    import torch

    from data_prep.ready.selections import read_points
    from gausim.io.ply import load_scene, save_scene
    from gausim.ops.selection import NearPoints, apply_masks

    files = scene_files(root)
    if SCENE not in files:
        return None
    scene = load_scene(files[SCENE], name="scene")
    masks: dict[str, Any] = {}
    for mask, cloud in (("simulated", MOVING), ("foreground", OBJECT)):
        if cloud in files:
            masks[mask] = NearPoints(torch.from_numpy(read_points(files[cloud])), near)(scene)
    if anchor is not None and "simulated" in masks and masks["simulated"].any():
        moving = NearPoints(scene.means[masks["simulated"]], anchor)(scene)
        masks["pinned"] = moving & masks.get("foreground", torch.ones_like(moving)) & ~masks["simulated"]
        if not masks["pinned"].any():
            raise SceneError(
                f"{files[MOVING]}: no kernel of the object is within {anchor:g} of the moving ones without being one. "
                "Give a larger --anchor, or mark the pins with `select`."
            )
        masks["simulated"] = masks["simulated"] | masks["pinned"]
    elif PINS in files:
        masks["pinned"] = torch.from_numpy(read_pins(files[PINS], scene.count))
    scene = apply_masks(scene, **masks)
    save_scene(scene, work / "scene.ply")
    return {"kernels": scene.count} | {n: int(getattr(scene, n).sum()) for n in ("simulated", "pinned", "foreground")}
