"""Selections of kernels as text: places, components, nearness to points, joined by and, or, not from left to right."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gausim.core import DataError, GaussianScene, SceneError
from gausim.io.npz import read_array
from gausim.io.ply import MASK_NAMES, read_ply
from gausim.ops.selection import Box, Component, HalfSpace, NearPoints, Selection, parse_half_space

# Syntax of a term, by its first word.
FORMS = {
    "all": "all", "below": "below AXIS=VALUE", "above": "above AXIS=VALUE", "box": "box X,Y,Z X,Y,Z",
    "near": "near FILE DISTANCE", "component": "component RADIUS [X,Y,Z]", "mask": "mask simulated|pinned|foreground",
}  # fmt: skip
GRAMMAR = "TERM [and|or] [not] TERM ..., a TERM being " + "; ".join(FORMS.values())
# Point sets above this would take hours against a scene.
_MOST_POINTS = 5_000_000


@dataclass(frozen=True)
class _Mask(Selection):
    """A mask that the scene has already."""

    name: str

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        return getattr(scene, self.name)


def parse_selection(text: str) -> tuple[Selection, list[Path]]:
    """The selection that a text describes, e.g. ``near moving.ply 0.01 and not below z=0.33``.

    There is no precedence: ``a or b and c`` is (a or b) and c. Distances and coordinates are in scene units.

    Returns:
        The selection and the files that it reads.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise SceneError(f"selection '{text}': {error}.") from error
    terms: list[tuple[str, list[str]]] = [("and", [])]
    for word in words:
        if word in ("and", "or"):
            terms.append((word, []))
        elif word == "not" and set(terms[-1][1]) - {"not"}:
            raise _wrong(text, "'not' where 'and' or 'or' should stand")
        else:
            terms[-1][1].append(word)
    chosen: Selection = HalfSpace(0)  # all
    files: list[Path] = []
    for joint, rest in terms:
        negate = False
        while rest[:1] == ["not"]:
            negate, rest = not negate, rest[1:]
        if not rest:
            raise _wrong(text, "a term is missing")
        term = _term(rest, text, files)
        term = ~term if negate else term
        chosen = chosen & term if joint == "and" else chosen | term
    return chosen, files


def read_points(path: Path) -> np.ndarray:
    """(P, 3) float32 points of an ``npz`` (array ``points``), a ``ply`` or a text of three numbers per line."""
    if path.suffix.lower() == ".ply":
        try:
            vertices = read_ply(path)["vertex"]
            points = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], 1)
        except (KeyError, ValueError, TypeError) as error:
            raise DataError(f"{path}: expected an element 'vertex' with numbers x, y and z ({error}).") from error
    elif not path.is_file():
        raise DataError(f"{path}: no such file. Expected points as npz, ply or txt.")
    elif path.suffix.lower() == ".npz":
        points = read_array(path, "points")
    else:
        try:
            rows = [line.split() for line in path.read_text("utf-8").replace(",", " ").splitlines()]
            points = np.array([[float(word) for word in row] for row in rows if row and row[0][0] != "#"])
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: expected three numbers per line ({error!s:.80}).") from error
    numeric = points.dtype.kind in "fiu"
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points) or not numeric or len(points) > _MOST_POINTS:
        raise DataError(
            f"{path}: field 'points': expected numbers of shape (P, 3), P from 1 to {_MOST_POINTS}, got {points.dtype} "
            f"{points.shape}."
        )
    if not np.isfinite(points).all() or np.abs(points).max() > 1e30:
        raise DataError(f"{path}: field 'points' holds NaN or infinite numbers. Export it again.")
    return points.astype(np.float32)


def _term(words: list[str], text: str, files: list[Path]) -> Selection:
    match words:
        case ["all"]:
            return HalfSpace(0)
        case ["below" | "above" as side, place]:
            half = parse_half_space(f"{side} {place}")
            if not math.isfinite(half.above if half.above is not None else half.below or 0.0):
                raise _wrong(text, f"'{place}' is not finite")
            return half
        case ["box", first, second]:
            a, b = _vector(first, text), _vector(second, text)
            low, high = (tuple(f(x, y) for x, y in zip(a, b, strict=True)) for f in (min, max))
            return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
        case ["near", file, distance]:
            files.append(Path(file))
            return NearPoints(torch.from_numpy(read_points(Path(file))), _positive(distance, text))
        case ["component", radius]:
            return Component(_positive(radius, text))
        case ["component", radius, seed]:
            return Component(_positive(radius, text), _vector(seed, text))
        case ["mask", name] if name in MASK_NAMES:
            return _Mask(name)
    form = FORMS.get(words[0] if words else "", "")
    raise _wrong(text, f"'{' '.join(words)}'" + (f", expected '{form}'" if form else " is no term"))


def _wrong(text: str, what: str) -> SceneError:
    return SceneError(f"selection '{text}': {what}. The form is: {GRAMMAR}.")


def _positive(word: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise _wrong(text, f"'{word}' must be a positive number of scene units")
    return value


def _vector(word: str, text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in word.split(","))
    except ValueError:
        raise _wrong(text, f"'{word}' must be three numbers X,Y,Z") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise _wrong(text, f"'{word}' is not finite")
    return x, y, z
