"""Selections that events act on: a unit of the hierarchy, listed kernels, a ball, or the whole object."""

import re
from collections.abc import Sequence
from itertools import groupby
from typing import Annotated, Any

import msgspec
import torch
from jaxtyping import Bool, Int
from msgspec import Meta
from torch import Tensor

from gausim.core import ConfigError, GaussianScene
from gausim.interaction.checked import Checked, Natural, Vector

# Largest number of kernels in a list; larger ones are taken for defects of the file.
MOST_KERNELS = 10_000_000


class Whole(Checked, frozen=True):
    """All simulated kernels."""

    def mask(self, scene: GaussianScene, units: Sequence[Int[Tensor, " K"]]) -> Bool[Tensor, " K"]:
        """True for the kernels that are selected."""
        return scene.simulated.clone()


class Unit(Checked, frozen=True):
    """The kernels of one unit of the hierarchy."""

    level: Natural  # 1 for the finest clusters, 2 for those of clusters, and so on; 0 for a kernel
    index: Natural  # index of the unit within its level

    def mask(self, scene: GaussianScene, units: Sequence[Int[Tensor, " K"]]) -> Bool[Tensor, " K"]:
        """True for the kernels of the unit; ``units`` has the unit of every kernel at levels 1, 2, ..., or -1.

        Raises:
            ConfigError: the level or unit does not exist.
        """
        if self.level == 0:
            return Kernels((self.index,)).mask(scene, units)
        if self.level > len(units):
            raise ConfigError(f"selection of level {self.level}: '{scene.name}' has levels 0 to {len(units)}.")
        unit = units[self.level - 1]
        chosen = unit == self.index
        if not bool(chosen.any()):
            has = f"level {self.level} of '{scene.name}' has units 0 to {int(unit.max())}"
            raise ConfigError(f"selection of unit {self.index}: {has}.")
        return chosen


class Kernels(Checked, frozen=True):
    """Listed kernels."""

    # indices of the kernels in the scene, ascending
    numbers: Annotated[tuple[Natural, ...], Meta(min_length=1, max_length=MOST_KERNELS)]

    def __post_init__(self) -> None:
        Checked.__post_init__(self)
        msgspec.structs.force_setattr(self, "numbers", tuple(sorted(set(self.numbers))))

    def mask(self, scene: GaussianScene, units: Sequence[Int[Tensor, " K"]]) -> Bool[Tensor, " K"]:
        """True for these kernels.

        Raises:
            ConfigError: an index exceeds the scene's kernels.
        """
        if self.numbers[-1] >= scene.count:
            has = f"'{scene.name}' has kernels 0 to {scene.count - 1}"
            raise ConfigError(f"selection of kernel {self.numbers[-1]}: {has}.")
        chosen = torch.zeros(scene.count, dtype=torch.bool, device=scene.means.device)
        chosen[list(self.numbers)] = True
        return chosen


class Ball(Checked, frozen=True):
    """Simulated kernels whose rest position lies in a ball."""

    centre: Vector  # its centre [scene units]
    radius: Annotated[float, Meta(gt=0, lt=1e9)]  # its radius [diagonals of the scene]

    def mask(self, scene: GaussianScene, units: Sequence[Int[Tensor, " K"]]) -> Bool[Tensor, " K"]:
        """True for the kernels inside.

        Raises:
            ConfigError: no kernel lies in the ball.
        """
        away = (scene.means.double() - scene.means.new_tensor(self.centre, dtype=torch.float64)).norm(dim=-1)
        chosen = scene.simulated & (away <= self.radius * scene.diagonal)
        if not bool(chosen.any()):
            within = f"within {self.radius:g} diagonals of {self.centre}"
            raise ConfigError(f"selection of a ball: no kernel of '{scene.name}' lies {within}.")
        return chosen


Selected = Whole | Unit | Kernels | Ball


def selection_to_json(on: Selected) -> dict[str, Any]:
    """The JSON value of a selection in session files; listed kernels as ranges, both ends included."""
    match on:
        case Whole():
            return {"whole": True}
        case Unit():
            return {"level": on.level, "unit": on.index}
        case Ball():
            return {"centre": list(on.centre), "radius": on.radius}
    runs = [[number for _, number in run] for _, run in groupby(enumerate(on.numbers), lambda x: x[1] - x[0])]
    return {"kernels": ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)}


def selection_from_json(value: Any) -> Selected:
    """Parses the JSON value of :func:`selection_to_json`.

    Raises:
        ConfigError: the value has another form; the message names the field.
    """
    match value:
        case {"whole": True, **more} if not more:
            return Whole()
        case {"level": level, "unit": index, **more} if not more:
            return Unit(level, index)
        case {"kernels": text, **more} if not more:
            return parse_kernels(text)
        case {"centre": centre, "radius": radius, **more} if not more:
            return Ball(centre, radius)
    forms = '{"whole": true}, {"level": L, "unit": I}, {"kernels": "0-9, 12"} or {"centre": [x, y, z], "radius": R}'
    raise ConfigError(f"field 'on': expected {forms}, got {str(value)[:80]}.")


def parse_kernels(text: Any) -> Kernels:
    """Parses a list of kernels such as ``0-9, 12``.

    Raises:
        ConfigError: the text has another form, or lists too many kernels.
    """
    expected, numbers = "field 'kernels': expected numbers and ranges, e.g. \"0-9, 12\"", list[int]()
    for part in str(text).split(","):
        match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", part, re.ASCII)
        if not match:
            raise ConfigError(f"{expected}, got {part[:80]!r}.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first or len(numbers) + last - first >= MOST_KERNELS:
            raise ConfigError(f"{expected} with at most {MOST_KERNELS} kernels, got {part[:80]!r}.")
        numbers.extend(range(first, last + 1))
    return Kernels(tuple(numbers))
