"""The rest scene of a data set: masks that the data config selects, and the pinned kernel that every scene needs."""

from __future__ import annotations

from collections.abc import Mapping

from gausim.core import ConfigError, GaussianScene, SceneError
from gausim.ops.selection import Selection, apply_masks, parse_half_space

MASKS = ("simulated", "pinned", "foreground")


def select_masks(scene: GaussianScene, selections: Mapping[str, Selection | str]) -> GaussianScene:
    """Replaces masks by selections, e.g. ``{"pinned": "z=0.33"}`` (below that height) or any ``Selection``.

    Raises:
        ConfigError: a mask that does not exist.
        SceneError: a selection is malformed or holds no kernel.
    """
    unknown = sorted(set(selections) - set(MASKS))
    if unknown:
        raise ConfigError(f"data.selections: no such mask {unknown}; expected some of {MASKS}.")
    given = {name: parse_half_space(s) if isinstance(s, str) else s for name, s in selections.items()}
    return apply_masks(
        scene, simulated=given.get("simulated"), pinned=given.get("pinned"), foreground=given.get("foreground")
    )


def require_pinned(scene: GaussianScene) -> GaussianScene:
    """Returns the scene, or raises :class:`SceneError` where no kernel is pinned, saying how to pin some."""
    if not scene.pinned.any():
        low, high = float(scene.means[:, 2].amin()), float(scene.means[:, 2].amax())
        raise SceneError(
            f"{scene.name}: no kernel is pinned, so nothing holds the object. Put a boolean array 'pinned' into the "
            f"scene's .masks.npz, or select kernels in the data config, e.g. data.selections.pinned='z="
            f"{low + 0.1 * (high - low):.3g}' for the lowest tenth; data.free_root=true if it floats."
        )
    return scene
