"""Selections of kernels by position, combined by ``&``, ``|`` and ``~`` and stored as masks."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene

AXES = {"x": 0, "y": 1, "z": 2}
# Pairs whose distances are computed at once (float32: 64 MiB).
_PAIRS_AT_ONCE = 1 << 24
# Largest mean number of kernels within one step; more indicate a radius of the object's size, not of its gaps.
_STEPS_PER_KERNEL, _FEW_STEPS = 400, 1 << 22


class Selection(ABC):
    """A rule that selects kernels of a scene; calling it gives one bool per kernel."""

    @abstractmethod
    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        """True for the kernels that are selected."""

    def __and__(self, other: "Selection") -> "Selection":
        return _Made(lambda scene: self(scene) & other(scene))

    def __or__(self, other: "Selection") -> "Selection":
        return _Made(lambda scene: self(scene) | other(scene))

    def __invert__(self) -> "Selection":
        return _Made(lambda scene: ~self(scene))


@dataclass(frozen=True)
class _Made(Selection):
    function: Callable[[GaussianScene], Bool[Tensor, " K"]]

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        return self.function(scene)


@dataclass(frozen=True)
class HalfSpace(Selection):
    """Kernels whose mean lies strictly below (or above) a value on one axis."""

    axis: int  # 0, 1 or 2 for x, y or z
    below: float | None = None  # select coordinates less than this [scene units]
    above: float | None = None  # select coordinates greater than this [scene units]

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        """True for the kernels on the selected side."""
        x = scene.means[:, self.axis]
        below = torch.inf if self.below is None else self.below
        return (x < below) & (x > (-torch.inf if self.above is None else self.above))


@dataclass(frozen=True)
class Box(Selection):
    """Kernels whose mean lies in an axis-aligned box, borders included [scene units]."""

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        """True for the kernels inside."""
        low, high = scene.means.new_tensor(self.minimum), scene.means.new_tensor(self.maximum)
        return ((scene.means >= low) & (scene.means <= high)).all(-1)


@dataclass(frozen=True, eq=False)
class NearPoints(Selection):
    """Kernels within a distance of any point of a cloud [scene units] (METHOD section 8: 0.01 for READY)."""

    points: Float[Tensor, "P 3"]
    distance: float

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        """True for the kernels near a point."""
        points = self.points.to(scene.means)
        chunks = scene.means.split(max(1, _PAIRS_AT_ONCE // max(1, len(points))))
        exact = "donot_use_mm_for_euclid_dist"  # the product form loses digits where distances are small
        near = [(torch.cdist(x, points, compute_mode=exact) <= self.distance).any(-1) for x in chunks]
        return torch.cat(near)


@dataclass(frozen=True)
class Component(Selection):
    """A connected component of the graph that links kernels whose means are within a radius."""

    radius: float  # largest distance of linked kernels [scene units]
    # the component of the kernel nearest to this point; the largest one when None
    seed: tuple[float, float, float] | None = None

    def __call__(self, scene: GaussianScene) -> Bool[Tensor, " K"]:
        """True for the kernels of that component.

        Raises:
            SceneError: the radius is not positive, or so large that too many kernels are linked to each.
        """
        means = scene.means.detach().double().cpu().numpy()
        tree = cKDTree(means)
        if not 0 < self.radius < float("inf"):
            raise SceneError(f"{scene.name}: component radius {self.radius:g}: expected more than 0 scene units.")
        steps = int(tree.count_neighbors(tree, self.radius))
        if steps > max(_STEPS_PER_KERNEL * scene.count, _FEW_STEPS):
            raise SceneError(
                f"{scene.name}: component radius {self.radius:g}: {steps / scene.count:.0f} kernels are within one "
                "step of each; choose one nearer to the distance between neighbours."
            )
        pairs = tree.query_pairs(self.radius, output_type="ndarray")
        links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(scene.count, scene.count))
        _, label = connected_components(links, directed=False)
        chosen = np.bincount(label).argmax() if self.seed is None else label[tree.query(np.array(self.seed))[1]]
        return torch.from_numpy(label == chosen).to(scene.means.device)


def parse_half_space(text: str) -> HalfSpace:
    """Reads ``[below|above] AXIS=VALUE``, e.g. ``above z=0.33``; without a side it is below.

    Raises:
        SceneError: the text has another form.
    """
    match = re.fullmatch(r"\s*(?:(below|above)\s)?\s*([xyz])\s*=\s*([-+0-9.eE]+)\s*", text)
    try:
        axis, value = AXES[match[2]], float(match[3])  # type: ignore[index]
    except (TypeError, ValueError) as error:
        raise SceneError(f"'{text}': expected 'below AXIS=VALUE' or 'above ...', e.g. 'below z=0.33'.") from error
    return HalfSpace(axis, above=value) if match and match[1] == "above" else HalfSpace(axis, below=value)


def require_pinned(scene: GaussianScene) -> GaussianScene:
    """Returns the scene if it has both pinned and free simulated kernels; a free body needs no pinned ones.

    Raises:
        SceneError: no kernel is simulated, none is pinned (with instructions to pin some), or no simulated one is free.
    """
    if not scene.simulated.any():
        raise SceneError(f"{scene.name}: mask 'simulated' marks no kernel; expected those of the object that moves.")
    if not scene.pinned.any() and not scene.surroundings.free:
        z = scene.means[scene.simulated, 2]
        low, high = float(z.amin()), float(z.amax())
        height = f"below z={low + 0.1 * (high - low):.3g}"
        raise SceneError(
            f"{scene.name}: no kernel is pinned; expected at least one root that holds the object. Store the mask with "
            f'`gausim inspect SCENE --pin "{height}" --save-masks` (here the lowest tenth; above where up is '
            f"negative), or select kernels in the data config, 'data.selections={{pinned: \"{height}\"}}'. Where "
            'nothing holds it, set "free": true in dataset.json.'
        )
    if not (scene.simulated & ~scene.pinned).any():
        raise SceneError(f"{scene.name}: every simulated kernel is pinned; expected some that are free to move.")
    return scene


def apply_masks(
    scene: GaussianScene,
    *,
    simulated: Selection | Bool[Tensor, " K"] | None = None,
    pinned: Selection | Bool[Tensor, " K"] | None = None,
    foreground: Selection | Bool[Tensor, " K"] | None = None,
) -> GaussianScene:
    """The scene with the given masks replaced; kernels that are not simulated lose their pins.

    Raises:
        SceneError: a given selection selects no kernel.
    """
    given = {"simulated": simulated, "pinned": pinned, "foreground": foreground}
    masks: dict[str, Any] = {n: v(scene) if isinstance(v, Selection) else v for n, v in given.items() if v is not None}
    for name, mask in masks.items():
        if not mask.any():
            low, high = scene.means.amin(0).tolist(), scene.means.amax(0).tolist()
            raise SceneError(
                f"{scene.name}: mask '{name}': the selection holds none of {scene.count} kernels. The scene spans "
                + ", ".join(f"{a} {low[i]:.3g}..{high[i]:.3g}" for a, i in AXES.items())
                + "; choose the axis and the value within."
            )
    masks["pinned"] = masks.get("pinned", scene.pinned) & masks.get("simulated", scene.simulated)
    return replace(scene, **masks).validated()
