"""The recursion of METHOD section 2: units deform about their parents, kernels inherit from the finest units."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import Frame
from gausim.models.hierarchy.batch import SceneBatch
from gausim.ops.deformation import apply, polar_rotation


@dataclass(frozen=True, eq=False)
class Units:
    """Mass-weighted aggregates of the N units of one level, in the order of its rows."""

    rest: Float[Tensor, "N 3"]  # X [scene units]
    now: Float[Tensor, "N 3"]  # x_t
    before: Float[Tensor, "N 3"]  # x_{t-1}
    mass: Float[Tensor, " N"]  # m_c = sum of m_i
    log_density: Float[Tensor, " N"]  # log of m_c / V_c
    attributes: Float[Tensor, "N A"]  # unweighted mean over the kernels
    floor: Float[Tensor, "N 4"] | None = None  # nearness to the floor, and its normal times the nearness
    older: tuple[Float[Tensor, "N 3"], ...] = ()  # x_{t-2}, x_{t-3}, ..., in models with memory


@dataclass(frozen=True, eq=False)
class Solved:
    """The solved level of the parents p (or the roots of the top level), and the parent of each unit below."""

    rest: Float[Tensor, "P 3"]  # X [scene units]
    now: Float[Tensor, "P 3"]  # x_t
    before: Float[Tensor, "P 3"]  # x_{t-1}
    after: Float[Tensor, "P 3"]  # x_{t+1}
    template: Float[Tensor, "P 3"]  # T_p
    deformation_gradient: Float[Tensor, "P 3 3"]  # C_p, accumulated
    rotation: Float[Tensor, "P 3 3"]  # Q_p, accumulated
    index: Int[Tensor, " N"]  # the parent of each of the N units below

    @classmethod
    def roots(cls, rest: Float[Tensor, "P 3"]) -> "Solved":
        """The parents of the units of the top level: one immobile root each."""
        identity = torch.eye(3, dtype=rest.dtype, device=rest.device).expand(len(rest), 3, 3).contiguous()
        index = torch.arange(len(rest), device=rest.device)
        return cls(rest, rest, rest, rest, rest, identity, identity, index)

    def carry(self, target: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The coarse prediction x_p + C_p (T - T_p)."""
        deformation_gradient = self.deformation_gradient.index_select(0, self.index)
        offset = target - self.template.index_select(0, self.index)
        return self.after.index_select(0, self.index) + apply(deformation_gradient, offset)


def advance(
    deformation_gradient: Float[Tensor, "N 3 3"],
    rotation: Float[Tensor, "N 3 3"],
    target: Float[Tensor, "N 3"],
    above: Solved,
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3 3"], Float[Tensor, "N 3"]]:
    """Accumulated deformation gradients C = F C_p and rotations Q, and new positions x_p + C (T - T_p) of the units.

    Args:
        deformation_gradient: F of the units.
        rotation: U V^T of the units.
        target: template positions T of the units [scene units].
        above: the solved parents.
    """
    accumulated = deformation_gradient @ above.deformation_gradient.index_select(0, above.index)
    offset = target - above.template.index_select(0, above.index)
    after = above.after.index_select(0, above.index) + apply(accumulated, offset)
    return accumulated, rotation @ above.rotation.index_select(0, above.index), after


def inherit(finest: Solved, template: Float[Tensor, "N 3 3"] | None, batch: SceneBatch) -> Frame:
    """Positions x_c + G_c (X_k - X_c) of all kernels, G and Q of the units and identity rows.

    Args:
        finest: the finest predicted level, solved.
        template: deformation gradients P of the template, G = C P; None for the identity. Their rotations are detached
            from the loss gradient, as they only rotate colours.
        batch: what every kernel inherits.
    """
    deformation_gradient, rotation = finest.deformation_gradient, finest.rotation
    if template is not None:
        deformation_gradient = deformation_gradient @ template
        rotation = rotation @ polar_rotation(template.detach())
    unit = batch.inherited.clamp_min(0)
    offset = batch.rest - finest.rest.index_select(0, unit)
    moved = finest.after.index_select(0, unit) + apply(deformation_gradient.index_select(0, unit), offset)
    positions = torch.where((batch.inherited < 0)[:, None], batch.rest, moved)
    identity = torch.eye(3, dtype=moved.dtype, device=moved.device).expand(batch.padded, 3, 3)
    rows = batch.rows
    return Frame(positions, identity.index_copy(0, rows, deformation_gradient), identity.index_copy(0, rows, rotation))
