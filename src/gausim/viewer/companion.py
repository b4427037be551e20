"""A second method beside the first, under the same events."""

from __future__ import annotations

import msgspec

from gausim.core import ConfigError, DivergenceError
from gausim.interaction.interaction import Interaction
from gausim.interaction.selections import Kernels, Unit
from gausim.interaction.session import Event


class Companion:
    """An interaction that repeats the events of another one.

    Attributes:
        name: name on the page.
        interaction: the simulation.
        message: error that stopped it or rejected an event; empty without an error.
    """

    def __init__(self, name: str, interaction: Interaction) -> None:
        self.name, self.interaction, self.message = name, interaction, ""

    def act(self, event: Event, leader: Interaction) -> None:
        """Applies an event of the leader; units become lists of kernels, as the hierarchies differ."""
        on = getattr(event, "on", None)
        if isinstance(on, Unit):
            chosen = on.mask(leader.scene, leader.units).nonzero()[:, 0].tolist()
            event = msgspec.structs.replace(event, on=Kernels(tuple(chosen)))
        try:
            self.interaction.act(event)
            self.message = ""
        except ConfigError as error:
            self.message = str(error)

    def step(self) -> None:
        """Simulates one frame, unless the simulation has diverged."""
        try:
            if self.interaction.broken is None:
                self.interaction.step()
        except (DivergenceError, ConfigError) as error:
            self.message = str(error)
