"""The contents of a viewer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausim.core import Cameras
from gausim.interaction.interaction import Interaction
from gausim.models.template.template import Property
from gausim.viewer.shown import Take


@dataclass(frozen=True, eq=False)
class Subject:
    """The contents of a viewer."""

    title: str  # heading of the page, one line
    interaction: Interaction  # the simulation
    takes: Sequence[Take] = ()  # recordings that can be played
    cameras: Cameras | None = None  # cameras of the data set, or None
    material: Mapping[str, Property] = field(default_factory=dict)  # learned properties of the kernels by name
    up: str = "z"  # vertical axis: x, y, z, -x, -y or -z
    sessions: Path = field(default_factory=lambda: Path("sessions"))  # folder of saved sessions
