"""Constants of a step, computed once for all steps between two updates of the parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import SimState
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.units import FixedUnits, UnitMotion, per_level, weighted_sum
from gausim.models.reference.reference import Carried, HandMotion, Reference
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
    frames: Frames  # the axes of levels, roots and template
    rest: Float[Tensor, "N 3"]  # centres of mass of the finest predicted units in scene axes [scene units]
    rest_outputs: tuple[Tensor, ...]  # per level, subtracted from the network's outputs; zeros without an anchor
    reference: Reference  # of bodies that move as a whole, or in hands

    def mean(self, positions: Float[Tensor, "K 3"]) -> Float[Tensor, "N 3"]:
        """Centres of mass of the finest predicted units."""
        return weighted_sum(positions, self.mass_fraction, self.batch.finest, self.batch.levels[-1].count)

    def finest(self, positions: Float[Tensor, "K 3"]) -> Float[Tensor, "N 3"]:
        """:meth:`mean` in the axes of the template."""
        return self._in_own_axes(self.mean(positions))

    def aggregate(self, state: SimState, hands: Sequence[HandMotion | None] | None) -> tuple[Carried, UnitMotion]:
        """The finest units relative to the reference, in the axes of the template, and the way back to the scene."""
        carried = self.reference.carry(self.mean(state.positions), self.mean(state.previous), state, hands)
        seen, axes = carried.relative, self.frames.axes[-1]
        load, floor = seen.load, seen.floor
        if load is not None:
            strain = axes @ load[:, 3:].unflatten(1, (3, 3)) @ axes.mT
            load = torch.cat((apply(axes, load[:, :3]), strain.flatten(1)), 1)
        if floor is not None:
            floor = torch.cat((floor[:, :1], apply(axes, floor[:, 1:])), 1)
        now, before = self._in_own_axes(seen.now), self._in_own_axes(seen.before)
        older = tuple(self.finest(positions) for positions in state.older)
        return carried, UnitMotion(self.levels[-1].rest, now, before, load, floor, older)

    def _in_own_axes(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return self.frames.into(len(self.levels) - 1, positions)

    def overshoot(self, state: SimState, displacement: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """The part of a displacement of the simulated kernels by an impulse that its frame does not reach."""
        batch, turned, axes = self.batch, self.reference.turned(state), self.frames.axes[-1]
        axes = axes if turned is None else axes @ turned.mT
        shifted = self.mean(torch.zeros_like(state.positions).index_copy(0, batch.simulated, displacement))
        remainder = apply(axes.mT, self.template.overshoot(apply(axes, shifted)))
        return remainder.index_select(0, batch.finest.index_select(0, batch.simulated))

    def per_level(self, finest: Float[Tensor, "N C"]) -> list[Tensor]:
        """Values of every predicted level, coarse to fine, such as positions: means of the finer units by mass."""
        return per_level(self.batch, [level.mass_fraction for level in self.levels], finest)

    def floors(self, motion: UnitMotion) -> Sequence[Tensor | None]:
        """Nearness to the floor of every predicted level, coarse to fine; None where there is no floor."""
        return [None] * len(self.levels) if motion.floor is None else self.per_level(motion.floor)

    def in_scene_axes(
        self, finest: Solved, template: Tensor | None, predicted: list[Tensor]
    ) -> tuple[Solved, Tensor | None, tuple[Tensor, ...]]:
        """The finest level, the template's P and all F in scene axes."""
        frames = self.frames
        turned = None if template is None else frames.turned_back(len(self.levels) - 1, template)
        return frames.back(finest, self.rest), turned, tuple(frames.turned_back(i, f) for i, f in enumerate(predicted))
