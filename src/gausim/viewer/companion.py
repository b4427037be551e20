"""Another run or baseline beside the first: the same is done to both."""

from __future__ import annotations

import msgspec

from gausim.core import ConfigError, DivergenceError
from gausim.interaction.interaction import Interaction
from gausim.interaction.selections import Kernels, Unit
from gausim.interaction.session import Event


class Companion:
    """An interaction that follows another one.

    Attributes:
        name: what it is called on the page.
        interaction: what is simulated.
        message: why it stands still or does not follow; empty while it does.
    """

    def __init__(self, name: str, interaction: Interaction) -> None:
        self.name, self.interaction, self.message = name, interaction, ""

    def act(self, event: Event, leader: Interaction) -> None:
        """Does what was done to the leader; units become lists of kernels, as the hierarchies differ."""
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
        """One frame on, unless it broke."""
        try:
            if self.interaction.broken is None:
                self.interaction.step()
        except (DivergenceError, ConfigError) as error:
            self.message = str(error)
