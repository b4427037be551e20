"""What a step needs and only parameters change: computed once for all steps between two updates of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.units import FixedUnits, per_level
from gausim.models.step.body_frame import Frames
from gausim.models.step.recursion import Solved
from gausim.models.template.template import Motion, TemplateState
from gausim.ops.aggregation import weighted_sum


@dataclass(frozen=True, eq=False)
class Prepared:
    """Constants of a batch between two updates of the parameters.

    Gradients flow through them, so one that was made with gradients serves the steps of one backward pass.

    Attributes:
        batch: what it was made for.
        mass: masses of the simulated kernels.
        share: mass of every kernel over that of its finest predicted unit; 0 for never-simulated kernels.
        levels: the predicted levels, coarse to fine.
        roots: what the top level hangs on.
        template: the template of the batch.
        frames: the bodies' axes in which levels, roots and template are; None where these are the scene's.
        rest: centres of mass of the finest predicted units in the scene's axes [scene units].
        still: the network's outputs at rest per level, taken off others; None where they are not.
        with_gradients: whether it was made with gradients enabled.
    """

    batch: SceneBatch
    mass: Float[Tensor, " M"]
    share: Float[Tensor, " K"]
    levels: tuple[FixedUnits, ...]
    roots: Solved
    template: Callable[[Motion], TemplateState]
    frames: Frames | None
    rest: Float[Tensor, "N 3"]
    still: tuple[Tensor, ...] | None
    with_gradients: bool

    def aggregate(self, positions: Float[Tensor, "K 3"]) -> list[Tensor]:
        """Centres of mass of the units of every predicted level, coarse to fine."""
        return self.per_level(weighted_sum(positions, self.share, self.batch.finest, self.batch.levels[-1].count))

    def units(self, positions: Float[Tensor, "K 3"]) -> list[Tensor]:
        """The same in the bodies' own axes, where these are used."""
        found = self.aggregate(positions)
        return found if self.frames is None else [self.frames.into(i, x) for i, x in enumerate(found)]

    def per_level(self, finest: Float[Tensor, "N 3"]) -> list[Tensor]:
        """Positions of every predicted level, coarse to fine: coarser units are the centres of mass of the finer."""
        return per_level(self.batch, [level.share for level in self.levels], finest)
