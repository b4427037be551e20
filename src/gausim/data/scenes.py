"""The rest scene of a data set: masks that the data config selects."""

from __future__ import annotations

from collections.abc import Mapping

from gausim.core import ConfigError, GaussianScene
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
