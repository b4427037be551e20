"""The contents of a viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausim.core import Cameras
from gausim.interaction.interaction import Interaction
from gausim.models.template.template import Property
from gausim.viewer.companion import Companion
from gausim.viewer.films import Films
from gausim.viewer.shown import Take


@dataclass(frozen=True, eq=False)
class Subject:
    """The contents of a viewer.

    Attributes:
        title: heading of the page, one line.
        interaction: the simulation.
        takes: recordings that can be played.
        companion: a second method shown beside the first, or None.
        films: the recorded videos, or None.
        cameras: cameras of the data set, or None.
        material: learned properties of the kernels by name.
        up: vertical axis: x, y, z, -x, -y or -z.
        sessions: folder of saved sessions.
    """

    title: str
    interaction: Interaction
    takes: Sequence[Take] = ()
    companion: Companion | None = None
    films: Films | None = None
    cameras: Cameras | None = None
    material: Mapping[str, Property] = field(default_factory=dict)
    up: str = "z"
    sessions: Path = field(default_factory=lambda: Path("sessions"))
