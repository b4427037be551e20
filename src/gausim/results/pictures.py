"""Small pictures of one evaluated sequence for display: truth and predictions in several cameras, with alpha.

Arrays of ``pictures.npz`` per object: ``OBJECT/facts`` (JSON text), ``OBJECT/truth`` and ``OBJECT/prediction/METHOD``
as (F, V, h, w, 4) uint8, colours premultiplied with alpha, and ``OBJECT/background`` (V, h, w, 3) if the recording
has one. No figures are computed from them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import UInt8

from gausim.core import RunError
from gausim.io.npz import read_npz

# Background colour of an object whose recording has no background.
PLAIN = (46, 48, 52)


@dataclass(frozen=True, eq=False)
class _Facts:
    object: str
    sequence: str
    fps: float
    first_unseen: int  # first frame not used in training
    views: tuple[str, ...]  # names of the V cameras
    heldout_views: tuple[str, ...]  # those not used in training


@dataclass(frozen=True, eq=False)
class Pictures(_Facts):
    """Pictures of one sequence of one object."""

    truth: UInt8[np.ndarray, "F V h w 4"]  # recorded frames, RGB premultiplied with alpha
    predictions: dict[str, np.ndarray] = field(default_factory=dict)  # likewise, by method
    background: UInt8[np.ndarray, "V h w 3"] | None = None  # recorded background, if known

    def over_background(self, frames: UInt8[np.ndarray, "F V h w 4"]) -> UInt8[np.ndarray, "F V h w 3"]:
        """Frames over the recorded background, or over plain grey."""
        behind = np.array(PLAIN, np.uint16) if self.background is None else self.background.astype(np.uint16)
        rest = 255 - frames[..., 3:].astype(np.uint16)
        return np.minimum(frames[..., :3] + (behind * rest + 127) // 255, 255).astype(np.uint8)


def save_pictures(path: Path, pictures: list[Pictures]) -> None:
    """Writes the pictures of all objects into one npz without pickles."""
    arrays: dict[str, Any] = {}
    for item in pictures:
        facts = {fact.name: getattr(item, fact.name) for fact in fields(_Facts)}
        arrays |= {f"{item.object}/facts": np.array(json.dumps(facts)), f"{item.object}/truth": item.truth}
        arrays |= {f"{item.object}/prediction/{name}": frames for name, frames in item.predictions.items()}
        if item.background is not None:
            arrays[f"{item.object}/background"] = item.background
    np.savez_compressed(path, **arrays)


def load_pictures(path: Path) -> list[Pictures]:
    """Reads a file of :func:`save_pictures`.

    Raises:
        RunError: the file is missing or malformed.
    """
    try:
        arrays = read_npz(path)
        names = [name.removesuffix("/facts") for name in arrays if name.endswith("/facts")]
        return [_pictures(name, arrays) for name in names]
    except (ValueError, KeyError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: cannot be read ({error}). Write it with `gausim evaluate RUN`.") from error


def kept_pictures(run: Path, name: str) -> list[Pictures]:
    """The pictures of an object in the evaluation of a run directory.

    Raises:
        RunError: there are none, or they cannot be read.
    """
    path = run / "evaluation" / "pictures.npz"
    if not path.is_file():
        raise RunError(f"its evaluation kept no pictures. Make them with `gausim evaluate {run}`.")
    return [item for item in load_pictures(path) if item.object == name]


def _pictures(name: str, arrays: dict[str, np.ndarray]) -> Pictures:
    facts = msgspec.json.decode(str(arrays[f"{name}/facts"]), type=_Facts)
    prefix, truth = f"{name}/prediction/", arrays[f"{name}/truth"]
    predictions = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    frames, views = len(truth), len(facts.views)
    background = arrays.get(f"{name}/background")
    for array in (truth, *predictions.values()):
        if array.dtype != np.uint8 or array.ndim != 5 or array.shape != (frames, views, *truth.shape[2:4], 4):
            raise ValueError(f"expected uint8 {(frames, views, *truth.shape[2:4], 4)}, got {array.dtype} {array.shape}")
    if not truth.size:
        raise ValueError("there are no pictures")
    if background is not None and (background.dtype != np.uint8 or background.shape != (*truth.shape[1:4], 3)):
        raise ValueError(f"the background has shape {background.shape}, expected {(*truth.shape[1:4], 3)}")
    return Pictures(**vars(facts), truth=truth, predictions=predictions, background=background)
