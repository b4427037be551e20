"""The scene of READY's and PhysDreamer's folders: a point cloud of Gaussians, and clouds and lists that mark parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from data_prep.ready.authors import MOVING, OBJECT, PINS, SCENE, read_pins
from gausim.core.errors import SceneError


def scene_files(root: Path) -> dict[str, Path]:
    """The files of the scene that are there, by name."""
    return {name: root / name for name in (SCENE, MOVING, OBJECT, PINS) if (root / name).is_file()}


def write_scene(work: Path, root: Path, near: float, *, anchor: float | None = None) -> dict[str, int] | None:
    """Writes ``scene.ply`` with its masks, where there is a point cloud, and returns how many kernels they mark.

    Args:
        work: the folder to write to.
        root: the folder with the clouds.
        near: kernels so close to the moving cloud are simulated, to the object's cloud foreground [scene units].
        anchor: kernels of the object that do not move, but are so close to what moves, are simulated and pinned
            [scene units]; None: the pins are those of the list.

    Raises:
        SceneError: the point cloud is no 3DGS scene, or a mask marks nothing.
        DataError: a cloud or the list is malformed.
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
