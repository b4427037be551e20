"""Marking kernels of a scene by where they are: which ones move, which are held, which are compared with video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.core import ConfigError, GaussianScene, SceneError

MASKS = ("simulated", "pinned", "foreground")
Bound = Sequence[float | int | None]


def box_mask(
    points: Float[Tensor, "K 3"], *, low: Bound | None = None, high: Bound | None = None
) -> Bool[Tensor, " K"]:
    """Points inside an axis-aligned box [scene units]; None leaves a side open."""
    mask = torch.ones(points.shape[0], dtype=torch.bool, device=points.device)
    for bound, sign in ((low, 1.0), (high, -1.0)):
        if bound is not None and len(bound) != 3:
            raise ConfigError(f"a selection box needs three bounds (x, y, z; null is open), got {list(bound)}.")
        for axis, value in enumerate(bound or ()):
            if value is not None:
                mask &= (points[:, axis] - value) * sign >= 0
    return mask


def apply_selections(scene: GaussianScene, selections: Mapping[str, Mapping[str, Bound | None]]) -> GaussianScene:
    """Replaces masks of a scene by boxes, e.g. ``{"pinned": {"high": [None, None, 0.3]}}``.

    Raises:
        ConfigError: a mask or bound that does not exist.
        SceneError: a box without a kernel.
    """
    masks: dict[str, Tensor] = {}
    for name, box in selections.items():
        unknown = set(box) - {"low", "high"}
        if name not in MASKS or unknown:
            raise ConfigError(f"selection '{name}' {dict(box)}: expected one of {MASKS} with 'low' and/or 'high'.")
        masks[name] = box_mask(scene.means, low=box.get("low"), high=box.get("high"))
        if not masks[name].any():
            raise SceneError(f"{scene.name}: selection '{name}' {dict(box)} holds none of {scene.count} kernels.")
    if "simulated" in masks and "pinned" not in masks:
        masks["pinned"] = scene.pinned & masks["simulated"]
    elif "pinned" in masks:
        masks["pinned"] = masks["pinned"] & masks.get("simulated", scene.simulated)
    return replace(scene, **masks).validated()


def require_pinned(scene: GaussianScene) -> GaussianScene:
    """Returns the scene, or raises :class:`SceneError` where no kernel is pinned, saying how to pin some."""
    if not scene.pinned.any():
        low, high = (scene.means[:, 2].amin(), scene.means[:, 2].amax())
        raise SceneError(
            f"{scene.name}: no kernel is pinned, so nothing holds the object. Put a boolean array 'pinned' into the "
            "scene's .masks.npz, or select kernels in the data config, e.g. pinned: {high: [null, null, "
            f"{float(low + 0.1 * (high - low)):.3g}]}} for the lowest tenth along z; free_root: true if it floats."
        )
    return scene
