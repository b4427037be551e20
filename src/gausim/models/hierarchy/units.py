"""Constants of the units of the predicted levels between two updates of the parameters (METHOD section 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.models.hierarchy.batch import SceneBatch


@dataclass(frozen=True, eq=False)
class UnitMotion:
    """Finest units of a batch, of a scene or of a member at t and t - 1, relative to the reference [scene units]."""

    rest: Float[Tensor, "N 3"]  # X
    now: Float[Tensor, "N 3"]
    before: Float[Tensor, "N 3"]
    # in the reference's axes: acceleration [scene units / frame^2], and the reference's displacement gradient by rows;
    # None for a reference at rest
    load: Float[Tensor, "N 12"] | None = None
    # nearness to the floor, and its normal in the reference's axes times the nearness; None: there is no floor
    floor: Float[Tensor, "N 4"] | None = None
    older: tuple[Float[Tensor, "N 3"], ...] = ()  # at t - 2, t - 3, ..., in models with memory


@dataclass(frozen=True, eq=False)
class FixedUnits:
    """Constants of the units of one level between two updates of the parameters."""

    rest: Float[Tensor, "N 3"]  # centres of mass X [scene units]
    mass: Float[Tensor, " N"]  # m_c = sum of m_i
    # m_c over the mass of its parent among the predicted levels; 1 at the top level
    mass_fraction: Float[Tensor, " N"]
    log_density: Float[Tensor, " N"]  # log of m_c / V_c
    attributes: Float[Tensor, "N A"]  # unweighted mean over the kernels
    # mass of the whole scene times its diagonal, the unit of momenta per step [mass scene units]
    scale: Float[Tensor, "N 1"]


def weighted_sum(
    values: Float[Tensor, "K C"], weights: Float[Tensor, " K"], index: Int[Tensor, " K"], count: int
) -> Float[Tensor, "N C"]:
    """Sum of w_k y_k over the members k of each of ``count`` units; ``index`` is the unit of every member."""
    return values.new_zeros(count, values.shape[1]).index_add(0, index, values * weights[:, None])


def per_level(batch: SceneBatch, fractions: Sequence[Tensor], finest: Float[Tensor, "N C"]) -> list[Tensor]:
    """Values of every predicted level, coarse to fine, such as positions: means of the finer units by mass."""
    values = [finest]
    for position in range(len(batch.levels) - 1, 0, -1):
        level, count = batch.levels[position], batch.levels[position - 1].count
        values.insert(0, weighted_sum(values[0], fractions[position], level.parent, count))
    return values


def fixed_units(
    batch: SceneBatch, mass: Float[Tensor, " M"], attributes: Float[Tensor, "M A"]
) -> tuple[Float[Tensor, " K"], tuple[FixedUnits, ...]]:
    """Mass fraction of every kernel in its finest unit, and constants of every predicted level (METHOD section 1)."""
    levels = batch.levels
    totals = [mass.new_zeros(level.count).index_add(0, level.unit_of_kernel, mass) for level in levels]
    within = mass / totals[-1].index_select(0, levels[-1].unit_of_kernel)
    fraction = mass.new_zeros(len(batch.rest)).index_copy(0, batch.simulated, within)
    fractions = [torch.ones_like(totals[0])]
    for above, total, level in zip(totals, totals[1:], levels[1:], strict=False):
        fractions.append(total / above.index_select(0, level.parent))
    rest = per_level(batch, fractions, weighted_sum(batch.rest, fraction, batch.finest, levels[-1].count))
    units = []
    for i, level in enumerate(levels):
        ones = torch.ones_like(mass)
        members = mass.new_zeros(level.count).index_add(0, level.unit_of_kernel, ones)[:, None]
        mean = mass.new_zeros(level.count, attributes.shape[1]).index_add(0, level.unit_of_kernel, attributes) / members
        log_density = torch.log(totals[i] / level.volume)
        whole = mass.new_zeros(len(level.spans)).index_add(0, level.member, totals[i])
        scale = whole.index_select(0, level.member)[:, None] * level.length
        units.append(FixedUnits(rest[i], totals[i], fractions[i], log_density, mean, scale))
    return fraction, tuple(units)
