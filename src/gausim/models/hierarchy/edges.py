"""The edges of a step: neighbours at rest and in the current state, in exact number or padded to a fixed shape."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from gausim.models.hierarchy.batch import LevelBatch
from gausim.ops.neighbours import (
    batched_radius_edges,
    coded_edges,
    combine_codes,
    edge_codes,
    neighbour_codes,
    no_edge,
)


def exact_edges(rule: str, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
    """Edges of a level whose units are at ``positions`` [scene units], sorted by destination, then source.

    Args:
        rule: neighbours at ``rest``, those of the ``current`` state, or the ``union`` or ``intersection`` of both.
        level: the units.
        positions: their current positions.
    """
    if rule == "rest":
        return level.rest_edges
    current = batched_radius_edges(positions, level.offsets, level.radii, level.max_neighbours)
    if rule == "current":
        return current
    rest, now = (edge_codes(edges, level.count) for edges in (level.rest_edges, current))
    combined = combine_codes(rest, now, level.count, rule=rule)
    return coded_edges(combined[combined < no_edge(level.count)], level.count)


def fixed_edges(rule: str, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
    """The same edges, padded to the largest possible number by edges N -> N of a dummy node; not for rule ``rest``.

    E does not depend on the positions, and the host is not synchronised.
    """
    codes = neighbour_codes(positions, level.member, level.device_radii, level.max_neighbours)
    if rule != "current":
        codes = combine_codes(edge_codes(level.rest_edges, level.count), codes, level.count, rule=rule)
    return coded_edges(codes, level.count)
