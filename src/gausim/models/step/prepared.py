"""Constants of a step, computed once for all steps between two updates of the parameters."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import SimState
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.units import FixedUnits, UnitMotion, per_level, weighted_sum
from gausim.models.reference.reference import Carried, HandMotion, Reference
from gausim.models.step.body_frame import Frames
from gausim.models.step.latest import Latest
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
        """Centres of mass of the finest predicted units; without loss gradients by a sparse product on the CPU."""
        if positions.device.type == "cpu" and not torch.is_grad_enabled():
            return self._means.of((positions,), lambda: self._sums @ positions)
        return weighted_sum(positions, self.mass_fraction, self.batch.finest, self.batch.levels[-1].count)

    @cached_property
    def _means(self) -> Latest[Tensor]:
        return Latest()

    @cached_property
    def _sums(self) -> Float[Tensor, "N K"]:
        """The matrix of :meth:`mean`."""
        (unit, order), count = torch.sort(self.batch.finest, stable=True), self.batch.levels[-1].count
        starts = torch.searchsorted(unit, torch.arange(count + 1, device=unit.device))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse")  # that its interface may change
            return torch.sparse_csr_tensor(starts, order, self.mass_fraction[order], (count, len(unit)))

    @cached_property
    def yielding(self) -> Float[Tensor, "K 1"]:
        """Displacement of every kernel in a frame per force on it; 0 for those that no force moves."""
        batch = self.batch
        shift = (batch.dt**2 / (2 * self.mass[:, None])).masked_fill(batch.pinned[:, None], 0.0)
        return torch.zeros_like(batch.rest[:, :1]).index_copy(0, batch.simulated, shift)

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

    def overshoot(self, state: SimState, displacement: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
        """The part of a displacement by an impulse that its frame does not reach, of the units of all kernels."""
        turned, axes = self.reference.turned(state), self.frames.axes[-1]
        axes = axes if turned is None else axes @ turned.mT
        remainder = apply(axes.mT, self.template.overshoot(apply(axes, self.mean(displacement))))
        return remainder.index_select(0, self.batch.finest)

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
