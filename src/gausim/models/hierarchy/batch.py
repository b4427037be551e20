"""Several sequences, of one or several scenes, as one disjoint graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import GaussianScene
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.ops.neighbours import batched_radius_edges, radius_edges


@dataclass(frozen=True, eq=False)
class Inheritance:
    """Which kernel inherits from which unit of the finest predicted level.

    Attributes:
        rest: rest positions of all kernels [scene units].
        unit: the unit of each kernel, -1 for kernels that never move.
        rows: where each unit stands among the ``padded`` rows of gradients; the other rows are identities.
        padded: number of these rows.
    """

    rest: Float[Tensor, "K 3"]
    unit: Int[Tensor, " K"]
    rows: Int[Tensor, " N"]
    padded: int


@dataclass(frozen=True, eq=False)
class Member:
    """Where one sequence stands in the disjoint union.

    Attributes:
        scene_id: which scene it is of.
        kernels: its rows of the state (all kernels of the scene).
        units: its rows of :class:`Step` gradients and rotations; the last of them is the identity unit.
        unit_of_kernel: unit of every kernel, counted from ``units.start``; pinned and never-simulated kernels point
            to the identity unit.
    """

    scene_id: int
    kernels: slice
    units: slice
    unit_of_kernel: Int[Tensor, " K"]


@dataclass(frozen=True, eq=False)
class LevelBatch:
    """One predicted level of the union.

    Attributes:
        unit_of_kernel: unit of every simulated kernel.
        parent: unit of the coarser predicted level, or at the coarsest one the simulated kernel that is the root.
        pinned: units that never move.
        free: 0 for these, 1 for all others; as a number, to multiply with.
        rest_edges: neighbours in rest space, sorted by destination.
        spans: rows of each member.
        length: bounding-box diagonal of the unit's scene [scene units].
        volume: volumes V_c.
        radii: largest edge length of each member [scene units], on the CPU.
        max_neighbours: edges into a unit, at rest and in the current state each.
    """

    unit_of_kernel: Int[Tensor, " K"]
    parent: Int[Tensor, " N"]
    pinned: Bool[Tensor, " N"]
    free: Float[Tensor, "N 1"]
    rest_edges: Int[Tensor, "2 E"]
    spans: tuple[slice, ...]
    length: Float[Tensor, "N 1"]
    dt: Float[Tensor, "N 1"]
    volume: Float[Tensor, " N"]
    radii: Float[Tensor, " S"]
    max_neighbours: int

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
        """``radii`` where the units are."""
        return self.radii.to(self.pinned.device)

    @cached_property
    def rest_table(self) -> tuple[Int[Tensor, "N k"], Bool[Tensor, "N k"]]:
        """``rest_edges`` as a table: the sources of each unit, and which entries are edges (the others follow)."""
        source, destination = self.rest_edges.cpu()
        degree = torch.bincount(destination, minlength=self.count)
        place = torch.arange(len(source)) - (degree.cumsum(0) - degree)[destination]
        index = torch.arange(self.count)[:, None].repeat(1, self.max_neighbours)
        index[destination, place] = source
        valid = torch.arange(self.max_neighbours) < degree[:, None]
        return index.to(self.pinned.device), valid.to(self.pinned.device)

    def current_edges(self, positions: Float[Tensor, "N 3"]) -> Int[Tensor, "2 E"]:
        """Neighbours in the current state, within each member, sorted by destination."""
        return batched_radius_edges(positions, self.offsets, self.radii, self.max_neighbours)


@dataclass(frozen=True, eq=False)
class SceneBatch:
    """The disjoint union of the scenes of several sequences.

    Attributes:
        members: one per sequence.
        levels: the predicted levels, coarse to fine.
        rest: rest positions of all kernels [scene units].
        simulated: rows of ``rest`` that the dynamics may move (level 0).
        pinned: which of the simulated kernels are held.
        volume: volumes of the simulated kernels.
        dt: frame interval of each simulated kernel's sequence [s].
        finest: unit of the finest predicted level of every kernel; 0 for never-simulated ones, which weigh nothing.
        kernels: which kernel inherits from which unit.
    """

    members: tuple[Member, ...]
    levels: tuple[LevelBatch, ...]
    rest: Float[Tensor, "K 3"]
    simulated: Int[Tensor, " M"]
    pinned: Bool[Tensor, " M"]
    volume: Float[Tensor, " M"]
    dt: Float[Tensor, "M 1"]
    finest: Int[Tensor, " K"]
    kernels: Inheritance

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """Scene of each member."""
        return tuple(m.scene_id for m in self.members)


def rows_by_scene(batch: SceneBatch) -> Iterator[tuple[int, Int[Tensor, " R"], list[int]]]:
    """Each scene of a batch, the rows of its members' finest units and the members."""
    spans = batch.levels[-1].spans
    for scene_id in sorted(set(batch.scene_ids)):
        members = [i for i, s in enumerate(batch.scene_ids) if s == scene_id]
        rows = torch.cat([torch.arange(spans[i].start, spans[i].stop) for i in members])
        yield scene_id, rows.to(batch.rest.device), members


@dataclass(frozen=True)
class GraphOptions:
    """Which units are neighbours: radius per predicted level (fractions of the diagonal) and the cap."""

    radii: tuple[float, ...]
    max_neighbours: int


class BatchBuilder:
    """Builds unions of scenes from parts computed once per scene."""

    def __init__(
        self,
        scenes: Sequence[GaussianScene],
        hierarchies: Sequence[Hierarchy],
        fps: Sequence[float],
        predicted: Sequence[int],
        graph: GraphOptions,
    ) -> None:
        """``predicted`` lists the predicted levels, coarse to fine; ``graph.radii`` follows the same order."""
        self.scenes, self.hierarchies, self.fps = scenes, hierarchies, fps
        self.predicted, self.graph = tuple(predicted), graph
        self._edges = [[self._rest_edges(h, i) for i in range(len(self.predicted))] for h in hierarchies]

    def _rest_edges(self, hierarchy: Hierarchy, position: int) -> Tensor:
        radius = self.graph.radii[position] * hierarchy.diagonal
        return radius_edges(hierarchy.levels[self.predicted[position]].rest, radius, self.graph.max_neighbours)

    def build(self, scene_ids: Sequence[int], device: torch.device) -> SceneBatch:
        """The union of the scenes ``scene_ids`` (repeats allowed), in that order."""
        members, kernels, units = [], 0, 0
        finest = self.predicted[-1]
        simulated, sim_counts = [], []
        for i in scene_ids:
            scene, hierarchy = self.scenes[i], self.hierarchies[i]
            count = hierarchy.levels[finest].count
            unit_of_kernel = torch.full((scene.count,), count)
            free = ~hierarchy.levels[0].pinned
            unit_of_kernel[hierarchy.kernels[free]] = hierarchy.ancestor(0, finest)[free]
            members.append(
                Member(
                    i, slice(kernels, kernels + scene.count), slice(units, units + count + 1), unit_of_kernel.to(device)
                )
            )
            simulated.append(hierarchy.kernels + kernels)
            sim_counts.append(hierarchy.levels[0].count)
            kernels, units = kernels + scene.count, units + count + 1
        base = [self.hierarchies[i].levels[0] for i in scene_ids]
        levels = tuple(self._level(p, scene_ids, sim_counts, device) for p in range(len(self.predicted)))
        rest, index = torch.cat([self.scenes[i].means for i in scene_ids]).to(device), torch.cat(simulated).to(device)
        pinned = torch.cat([b.pinned for b in base]).to(device)
        dt = torch.tensor([1.0 / self.fps[i] for i in scene_ids], dtype=self.scenes[0].means.dtype)
        return SceneBatch(
            members=tuple(members),
            levels=levels,
            rest=rest,
            simulated=index,
            pinned=pinned,
            volume=torch.cat([b.volume for b in base]).to(device),
            dt=dt.repeat_interleave(torch.tensor(sim_counts))[:, None].to(device),
            finest=torch.zeros(kernels, dtype=torch.int64, device=device).index_copy(
                0, index, levels[-1].unit_of_kernel
            ),
            kernels=_inheritance(rest, index, pinned, levels[-1]),
        )

    def _level(
        self, position: int, scene_ids: Sequence[int], sim_counts: list[int], device: torch.device
    ) -> LevelBatch:
        level = self.predicted[position]
        chosen = [self.hierarchies[i] for i in scene_ids]
        counts = [h.levels[level].count for h in chosen]
        starts = [sum(counts[:j]) for j in range(len(counts))]
        if position == 0:
            above = [h.levels[level].root for h in chosen]
            above_counts = sim_counts
        else:
            coarser = self.predicted[position - 1]
            above = [h.ancestor(level, coarser) for h in chosen]
            above_counts = [h.levels[coarser].count for h in chosen]
        above_starts = [sum(above_counts[:j]) for j in range(len(counts))]

        def join(parts: list[Tensor], offsets: list[int], dim: int = 0) -> Tensor:
            return torch.cat([p + o for p, o in zip(parts, offsets, strict=True)], dim).to(device)

        def spread(values: list[float]) -> Tensor:
            column = torch.tensor(values, dtype=self.scenes[0].means.dtype)
            return column.repeat_interleave(torch.tensor(counts))[:, None].to(device)

        pinned = torch.cat([h.levels[level].pinned for h in chosen]).to(device)
        return LevelBatch(
            unit_of_kernel=join([h.ancestor(0, level) for h in chosen], starts),
            parent=join(above, above_starts),
            pinned=pinned,
            free=(~pinned).to(self.scenes[0].means.dtype)[:, None],
            rest_edges=join([self._edges[i][position] for i in scene_ids], starts, 1),
            spans=tuple(slice(s, s + c) for s, c in zip(starts, counts, strict=True)),
            length=spread([h.diagonal for h in chosen]),
            dt=spread([1.0 / self.fps[i] for i in scene_ids]),
            volume=torch.cat([h.levels[level].volume for h in chosen]).to(device),
            radii=torch.tensor([self.graph.radii[position] * h.diagonal for h in chosen], dtype=torch.float64),
            max_neighbours=self.graph.max_neighbours,
        )


def _inheritance(rest: Tensor, simulated: Tensor, pinned: Tensor, finest: LevelBatch) -> Inheritance:
    """Free kernels follow their unit; behind the units of every member stands the identity of its held kernels."""
    unit = torch.where(pinned, -1, finest.unit_of_kernel)
    held = torch.full((len(rest),), -1, device=rest.device)
    rows = torch.cat([torch.arange(span.start, span.stop) + i for i, span in enumerate(finest.spans)]).to(rest.device)
    return Inheritance(rest, held.index_copy(0, simulated, unit), rows, len(rows) + len(finest.spans))
