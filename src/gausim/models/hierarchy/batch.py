"""Batches of sequences, of one or several scenes, as one disjoint graph, and the edges of its steps."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.settings import HierarchySettings
from gausim.ops.neighbours import (
    batched_radius_edges,
    coded_edges,
    combine_codes,
    edge_codes,
    neighbour_codes,
    no_edge,
    radius_edges,
)


@dataclass(frozen=True, eq=False)
class Member:
    """Rows of one sequence in the disjoint union."""

    scene_id: int  # index of its scene
    kernels: slice  # its rows of the state (all kernels of the scene)
    units: slice  # its rows of a :class:`Step`; the last of them is the identity unit
    # unit of every kernel, counted from `units.start`; never-simulated kernels point to the identity unit, and pinned
    # ones without hands
    unit_of_kernel: Int[Tensor, " K"]
    free: bool = False  # whether nothing holds the body


@dataclass(frozen=True, eq=False)
class LevelBatch:
    """One predicted level of the union."""

    unit_of_kernel: Int[Tensor, " K"]  # unit of every simulated kernel
    # unit of the coarser predicted level, or at the coarsest one the simulated kernel that is the root
    parent: Int[Tensor, " N"]
    pinned: Bool[Tensor, " N"]  # units that never move
    free: Float[Tensor, "N 1"]  # 0 for pinned units, 1 for the others
    rest_edges: Int[Tensor, "2 E"]  # neighbours in rest space, sorted by destination
    spans: tuple[slice, ...]  # rows of each member
    length: Float[Tensor, "N 1"]  # bounding-box diagonal of the unit's scene [scene units]
    dt: Float[Tensor, "N 1"]
    volume: Float[Tensor, " N"]  # volumes V_c
    radii: Float[Tensor, " S"]  # largest edge length of each member [scene units], on the CPU
    max_neighbours: int  # largest number of edges into a unit, separately at rest and in the current state

    @property
    def count(self) -> int:
        """Number of units in the union."""
        return self.pinned.shape[0]

    @cached_property
    def offsets(self) -> Int[Tensor, " S_and_end"]:
        """First unit of each member, then their number; on the CPU."""
        return torch.tensor([*(span.start for span in self.spans), self.count])

    @cached_property
    def member(self) -> Int[Tensor, " N"]:
        """The member of each unit."""
        return torch.arange(len(self.spans)).repeat_interleave(self.offsets.diff()).to(self.pinned.device)

    @cached_property
    def device_radii(self) -> Float[Tensor, " S"]:
        """``radii`` on the device of the units."""
        return self.radii.to(self.pinned.device)


def exact_edges(rule: str, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
    """Edges of a level whose units are at ``positions`` [scene units], sorted by destination, then source.

    Args:
        rule: neighbours at ``rest``, or their ``union`` or ``intersection`` with those of the current state.
        level: the units.
        positions: their current positions.
    """
    if rule == "rest":
        return level.rest_edges
    current = batched_radius_edges(positions, level.offsets, level.radii, level.max_neighbours)
    rest, now = (edge_codes(edges, level.count) for edges in (level.rest_edges, current))
    combined = combine_codes(rest, now, level.count, rule=rule)
    return coded_edges(combined[combined < no_edge(level.count)], level.count)


def fixed_edges(rule: str, level: LevelBatch, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
    """The same edges, padded to the largest possible number by edges N -> N of a dummy node; not for rule ``rest``.

    E does not depend on the positions, and the host is not synchronised.
    """
    codes = neighbour_codes(positions, level.member, level.device_radii, level.max_neighbours)
    return coded_edges(
        combine_codes(edge_codes(level.rest_edges, level.count), codes, level.count, rule=rule), level.count
    )


@dataclass(frozen=True, eq=False)
class SceneBatch:
    """The disjoint union of the scenes of several sequences."""

    members: tuple[Member, ...]  # one per sequence
    levels: tuple[LevelBatch, ...]  # the predicted levels, coarse to fine
    rest: Float[Tensor, "K 3"]  # rest positions of all kernels [scene units]
    simulated: Int[Tensor, " M"]  # rows of `rest` that the dynamics may move (level 0)
    pinned: Bool[Tensor, " M"]  # mask of the pinned among the simulated kernels
    volume: Float[Tensor, " M"]  # volumes of the simulated kernels
    dt: Float[Tensor, "M 1"]  # frame interval of each simulated kernel's sequence [s]
    # unit of the finest predicted level of every kernel; 0 for never-simulated kernels, whose mass fraction is 0
    finest: Int[Tensor, " K"]
    # the unit of that level whose motion each kernel inherits, -1 for kernels that never move
    inherited: Int[Tensor, " K"]
    # row of each of these units among the `padded` rows of deformation gradients; the other rows, one after each
    # member's units, are identities for its kernels that never move
    rows: Int[Tensor, " N"]
    padded: int  # number of rows, identities included

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """Scene of each member."""
        return tuple(m.scene_id for m in self.members)

    @cached_property
    def scene_index(self) -> Int[Tensor, " S"]:
        """``scene_ids`` on the device."""
        return torch.tensor(self.scene_ids, device=self.rest.device)

    @cached_property
    def rows_by_scene(self) -> tuple[tuple[int, Int[Tensor, " R"], list[int]], ...]:
        """For each scene its index, the rows of its members' finest units, and the members."""
        spans, by_scene = self.levels[-1].spans, []
        for scene_id in sorted(set(self.scene_ids)):
            members = [i for i, s in enumerate(self.scene_ids) if s == scene_id]
            rows = torch.cat([torch.arange(spans[i].start, spans[i].stop) for i in members])
            by_scene.append((scene_id, rows.to(self.rest.device), members))
        return tuple(by_scene)


class BatchBuilder:
    """Builds unions of scenes from parts computed once per scene."""

    def __init__(
        self,
        scenes: Sequence[GaussianScene],
        hierarchies: Sequence[Hierarchy],
        fps: Sequence[float],
        settings: HierarchySettings,
    ) -> None:
        """Computes the edges at rest of every scene."""
        self.scenes, self.hierarchies, self.fps, self.settings = scenes, hierarchies, fps, settings
        self._edges = [
            [
                radius_edges(h.levels[level].rest, length * h.diagonal, settings.max_neighbours)
                for level, length in zip(settings.predicted, settings.edge_lengths, strict=True)
            ]
            for h in hierarchies
        ]

    def build(self, scene_ids: Sequence[int], device: torch.device) -> SceneBatch:
        """The union of the scenes ``scene_ids`` (repeats allowed), in that order."""
        scenes, chosen = [self.scenes[i] for i in scene_ids], [self.hierarchies[i] for i in scene_ids]
        base, finest = [h.levels[0] for h in chosen], self.settings.predicted[-1]
        kernels = _starts([scene.count for scene in scenes])
        units = _starts([h.levels[finest].count + 1 for h in chosen])
        members = []
        for j, (scene, hierarchy) in enumerate(zip(scenes, chosen, strict=True)):
            unit_of_kernel = torch.full((scene.count,), hierarchy.levels[finest].count)
            # A pinned kernel has the identity, unless a hand turns it.
            free = ~base[j].pinned if scene.hand is None else torch.ones_like(base[j].pinned)
            unit_of_kernel[hierarchy.kernels[free]] = hierarchy.ancestor(0, finest)[free]
            own = slice(*kernels[j : j + 2]), slice(*units[j : j + 2])
            members.append(Member(scene_ids[j], *own, unit_of_kernel.to(device), scene.surroundings.free))
        levels = tuple(self._level(p, scene_ids, device) for p in range(len(self.settings.predicted)))
        index = _joined([h.kernels for h in chosen], kernels, device)
        pinned = torch.cat([b.pinned for b in base]).to(device)
        unit, spans = levels[-1].unit_of_kernel, levels[-1].spans
        still = torch.full((kernels[-1],), -1, device=device)
        rows = torch.cat([torch.arange(span.start, span.stop) + i for i, span in enumerate(spans)]).to(device)
        return SceneBatch(
            members=tuple(members),
            levels=levels,
            rest=torch.cat([scene.means for scene in scenes]).to(device),
            simulated=index,
            pinned=pinned,
            volume=torch.cat([b.volume for b in base]).to(device),
            dt=self._spread([1.0 / self.fps[i] for i in scene_ids], [b.count for b in base]).to(device),
            finest=torch.zeros(kernels[-1], dtype=torch.int64, device=device).index_copy(0, index, unit),
            inherited=still.index_copy(0, index, torch.where(pinned, -1, unit)),
            rows=rows,
            padded=len(rows) + len(spans),
        )

    def _level(self, position: int, scene_ids: Sequence[int], device: torch.device) -> LevelBatch:
        predicted, settings = self.settings.predicted, self.settings
        level, chosen = predicted[position], [self.hierarchies[i] for i in scene_ids]
        counts = [h.levels[level].count for h in chosen]
        starts = _starts(counts)
        coarser = predicted[position - 1] if position else 0  # the roots are kernels
        above = [h.ancestor(level, coarser) if position else h.levels[level].root for h in chosen]
        pinned = torch.cat([h.levels[level].pinned for h in chosen]).to(device)
        return LevelBatch(
            unit_of_kernel=_joined([h.ancestor(0, level) for h in chosen], starts, device),
            parent=_joined(above, _starts([h.levels[coarser].count for h in chosen]), device),
            pinned=pinned,
            free=(~pinned).to(self.scenes[0].means.dtype)[:, None],
            rest_edges=_joined([self._edges[i][position] for i in scene_ids], starts, device),
            spans=tuple(slice(*pair) for pair in itertools.pairwise(starts)),
            length=self._spread([h.diagonal for h in chosen], counts).to(device),
            dt=self._spread([1.0 / self.fps[i] for i in scene_ids], counts).to(device),
            volume=torch.cat([h.levels[level].volume for h in chosen]).to(device),
            radii=torch.tensor([settings.edge_lengths[position] * h.diagonal for h in chosen], dtype=torch.float64),
            max_neighbours=settings.max_neighbours,
        )

    def _spread(self, values: list[float], counts: list[int]) -> Tensor:
        column = torch.tensor(values, dtype=self.scenes[0].means.dtype)
        return column.repeat_interleave(torch.tensor(counts))[:, None]


def _starts(counts: list[int]) -> list[int]:
    """First row of each member, then the total number of rows."""
    return [0, *itertools.accumulate(counts)]


def _joined(parts: list[Tensor], starts: list[int], device: torch.device) -> Tensor:
    """Concatenation along the last axis of member indices, shifted to indices of the union."""
    return torch.cat([p + start for p, start in zip(parts, starts, strict=False)], -1).to(device)
