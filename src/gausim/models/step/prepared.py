"""Constants of a step, computed once for all steps between two updates of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import SimState
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.units import FixedUnits, per_level, weighted_sum
from gausim.models.reference.reference import Carried, HandMotion, Reference, UnitMotion
from gausim.models.step.body_frame import Frames
from gausim.models.step.recursion import Solved
from gausim.models.template.template import PreparedTemplate
from gausim.ops.deformation import apply


@dataclass(frozen=True, eq=False)
class Prepared:
    """Constants of a batch between two updates of the parameters.

    Loss gradients flow through them, so an instance made with gradients serves the steps of one backward pass.
    """

    batch: SceneBatch  # the batch whose constants these are
    mass: Float[Tensor, " M"]  # masses of the simulated kernels
    # mass of every kernel over that of its finest predicted unit; 0 for never-simulated kernels
    mass_fraction: Float[Tensor, " K"]
    levels: tuple[FixedUnits, ...]  # the predicted levels, coarse to fine
    roots: Solved  # parents of the top level
    template: PreparedTemplate  # the template of the batch
    frames: Frames | None  # body axes of levels, roots and template; None where these are in scene axes
    rest: Float[Tensor, "N 3"]  # centres of mass of the finest predicted units in scene axes [scene units]
    # the network's outputs at rest per level, subtracted from every output; None without an anchor
    still: tuple[Tensor, ...] | None

    # of bodies that move as a whole, or in hands
    reference: Reference

    def aggregate(self, positions: Float[Tensor, "K 3"]) -> Float[Tensor, "N 3"]:
        """Centres of mass of the finest predicted units."""
        return weighted_sum(positions, self.mass_fraction, self.batch.finest, self.batch.levels[-1].count)

    def finest(self, positions: Float[Tensor, "K 3"]) -> Float[Tensor, "N 3"]:
        """:meth:`aggregate` in body axes, where these are used."""
        return self._in_body_axes(self.aggregate(positions))

    def carried(self, state: SimState, hands: Sequence[HandMotion | None] | None) -> tuple[Carried, UnitMotion]:
        """A state relative to the reference: the way back, and the finest units in body axes, where these are used."""
        carried = self.reference.carry(self.aggregate(state.positions), self.aggregate(state.previous), state, hands)
        seen = carried.relative
        load, floor = seen.load, seen.floor
        if self.frames is not None:
            axes = self.frames.axes[-1]
            if load is not None:
                strain = axes @ load[:, 3:].unflatten(1, (3, 3)) @ axes.mT
                load = torch.cat((apply(axes, load[:, :3]), strain.flatten(1)), 1)
            floor = None if floor is None else torch.cat((floor[:, :1], apply(axes, floor[:, 1:])), 1)
        return carried, UnitMotion(self._in_body_axes(seen.now), self._in_body_axes(seen.before), load, floor)

    def _in_body_axes(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return positions if self.frames is None else self.frames.into(len(self.levels) - 1, positions)

    def withheld(self, state: SimState, displacement: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """The part of a displacement of the simulated kernels by an impulse that its frame does not reach."""
        batch, turned = self.batch, self.reference.turned(state)
        axes = None if self.frames is None else self.frames.axes[-1]  # those of the template
        if turned is not None:
            axes = turned.mT if axes is None else axes @ turned.mT
        own = self.aggregate(torch.zeros_like(state.positions).index_copy(0, batch.simulated, displacement))
        found = self.template.withheld(own if axes is None else apply(axes, own))
        found = found if axes is None else apply(axes.mT, found)
        return found.index_select(0, batch.finest.index_select(0, batch.simulated))

    def per_level(self, finest: Float[Tensor, "N C"]) -> list[Tensor]:
        """Values of every predicted level, coarse to fine, such as positions: means of the finer units by mass."""
        return per_level(self.batch, [level.mass_fraction for level in self.levels], finest)

    def floors(self, units: UnitMotion) -> Sequence[Tensor | None]:
        """Nearness to the floor of every predicted level, coarse to fine; None where there is no floor."""
        return [None] * len(self.levels) if units.floor is None else self.per_level(units.floor)

    def in_scene_axes(
        self, finest: Solved, template: Tensor | None, predicted: list[Tensor]
    ) -> tuple[Solved, Tensor | None, list[Tensor]]:
        """The finest level, the template's P and all F in scene axes."""
        frames = self.frames
        if frames is None:
            return finest, template, predicted
        turned = None if template is None else frames.turned_back(len(self.levels) - 1, template)
        return frames.back(finest, self.rest), turned, [frames.turned_back(i, f) for i, f in enumerate(predicted)]
