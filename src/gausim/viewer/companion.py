"""Another run or baseline beside the first: the same is done to both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

from gausim.core import ConfigError, DivergenceError
from gausim.interaction.interaction import Interaction
from gausim.interaction.selections import Ball, Kernels, Whole
from gausim.interaction.session import Event
from gausim.viewer.shown import Shown


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
        if on is not None and not isinstance(on, Whole | Ball | Kernels):
            chosen = on.mask(leader.scene, leader.units).nonzero()[:, 0].tolist()
            event = cast(Event, replace(cast(Any, event), on=Kernels(tuple(chosen))))
        try:
            self.interaction.act(event)
            self.message = ""
        except ConfigError as error:
            self.message = str(error)

    def step(self) -> None:
        """One frame on, unless it broke."""
        if self.interaction.broken is not None:
            return
        try:
            self.interaction.step()
        except (DivergenceError, ConfigError) as error:
            self.message = str(error)

    def reset(self) -> None:
        """Back to its initial state."""
        self.interaction.reset()
        self.message = ""

    def restart(self) -> None:
        """A new session."""
        self.interaction.restart()
        self.message = ""

    def shown(self) -> Shown:
        """Its latest frame."""
        now = self.interaction
        speed = (now.state.positions - now.state.previous).norm(dim=-1) * now.fps
        return Shown(now.frame, now.unit_of_kernel, speed)
