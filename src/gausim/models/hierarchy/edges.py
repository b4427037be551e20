"""The edges of a step: neighbours at rest and in the current state, with shapes that may stay fixed."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import ConfigError
from gausim.models.hierarchy.batch import LevelBatch
from gausim.ops.neighbours import combine_edges, combine_tables, neighbour_table

EDGE_RULES = ("rest", "current", "union", "intersection")


class EdgeSet:
    """Which edges the network sees.

    Edges are sorted by destination, then source. Edges of the dummy node, N -> N, only fill up the number of edges: no
    other edge touches that node.
    """

    def __init__(self, rule: str) -> None:
        """Chooses the rule.

        Args:
            rule: neighbours at ``rest``, those of the ``current`` state, or the ``union`` or ``intersection`` of both.

        Raises:
            ConfigError: an unknown rule.
        """
        if rule not in EDGE_RULES:
            raise ConfigError(f"model.simulator.hierarchy.edges is '{rule}'; expected one of {', '.join(EDGE_RULES)}.")
        self.rule = rule

    def of(self, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
        """Edges of a level whose units are at ``positions`` [scene units], without those of the dummy node."""
        if self.rule == "rest":
            return level.rest_edges
        current = level.current_edges(positions)
        if self.rule == "current":
            return current
        return combine_edges(level.rest_edges, current, level.count, rule=self.rule)

    def fixed(self, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
        """The same edges, and as many of the dummy node as there might be more; not for the rule ``rest``.

        E is the same for all positions, and nothing is read back to the host.
        """
        source, valid = neighbour_table(positions, level.member, level.device_radii, level.max_neighbours)
        if self.rule != "current":
            source, valid = combine_tables(level.rest_table, (source, valid), rule=self.rule)
        count = level.count
        destination = torch.arange(count, device=source.device)[:, None].expand_as(source)
        code = torch.where(valid, destination * (count + 1) + source, count * (count + 2)).flatten().sort().values
        return torch.stack((code % (count + 1), code // (count + 1)))
