"""Neighbours of points and of disjoint unions: the search in a tree, the codes of torch operations, unions of edges."""

from __future__ import annotations

import pytest
import torch

from gausim.ops.neighbours import (
    batched_radius_edges,
    coded_edges,
    neighbour_codes,
    no_edge,
    radius_edges,
)

SIZES = (40, 1, 73, 0, 25)
RADII = torch.tensor([0.3, 0.5, 0.25, 1.0, 0.02])


def _union(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points of members that overlap in space, their offsets, and the member of every point."""
    points = torch.rand(sum(SIZES), 3, generator=torch.Generator().manual_seed(seed))
    sizes = torch.tensor(SIZES)
    offsets = torch.cat((torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)))
    return points, offsets, torch.arange(len(SIZES)).repeat_interleave(sizes)


def _edges(codes: torch.Tensor, count: int) -> torch.Tensor:
    return coded_edges(codes[codes < no_edge(count)], count)


def _lowest_index_first(points: torch.Tensor, radius: float, cap: int) -> torch.Tensor:
    rows = []
    for d in range(len(points)):
        square = (points - points[d]).square().sum(1)
        near = [s for s in square.sort(stable=True).indices.tolist() if s != d and square[s] < radius**2]
        rows += [(s, d) for s in sorted(near[:cap])]
    return torch.tensor(rows, dtype=torch.int64).view(-1, 2).T


@pytest.mark.parametrize(("radius", "cap"), [(0.5, 100), (0.8, 4), (0.01, 4)])
def test_equals_brute_force_and_is_sorted(radius: float, cap: int) -> None:
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0))
    expected = _lowest_index_first(points, radius, cap)
    assert torch.equal(radius_edges(points, radius, cap), expected)


@pytest.mark.parametrize("cap", [1, 4, 200])
def test_a_union_is_its_members_side_by_side_in_both_searches(cap: int, monkeypatch: pytest.MonkeyPatch) -> None:
    points, offsets, member = _union()
    expected = []
    for low, high, radius in zip(offsets, offsets[1:], RADII, strict=False):
        if high > low:
            expected.append(radius_edges(points[low:high], float(radius), cap) + low)
    edges = batched_radius_edges(points, offsets, RADII, cap)
    assert edges.shape[1] > 50 and torch.equal(edges, torch.cat(expected, 1))
    monkeypatch.setattr("gausim.ops.neighbours.TABLE_ELEMENTS", 10 * len(points))  # ten rows at a time
    codes = neighbour_codes(points, member, RADII, cap)
    assert codes.shape == (len(points) * cap,)
    assert torch.equal(_edges(codes, len(points)), edges)


@pytest.mark.parametrize("cap", [3, 8])
def test_ties_go_to_the_lower_index_in_both(cap: int) -> None:
    points = torch.cartesian_prod(*[torch.arange(5.0)] * 3)
    expected = _lowest_index_first(points, 2.5, cap)
    assert torch.equal(radius_edges(points, 2.5, cap), expected)
    codes = neighbour_codes(points, torch.zeros(len(points), dtype=torch.int64), torch.tensor([2.5]), cap)
    assert torch.equal(_edges(codes, len(points)), expected)


def test_a_distance_equal_to_the_radius_is_no_edge() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0.5, 0]])
    assert radius_edges(points, 1.0, 5).tolist() == [[2, 1], [1, 2]]
    codes = neighbour_codes(points, torch.zeros(3, dtype=torch.int64), torch.tensor([1.0]), 2)
    assert _edges(codes, 3).tolist() == [[2, 1], [1, 2]]


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_clumps_lines_and_outliers_equal_brute_force(scale: float) -> None:
    """Where the distance to the next neighbour jumps by orders of magnitude, from zero on."""
    generator = torch.Generator().manual_seed(2)
    clump = torch.rand(60, 3, generator=generator) * 1e-3 + 0.5
    line = torch.linspace(0, 1, 50)[:, None].expand(50, 3)
    points = torch.cat((clump, line, torch.full((30, 3), 0.25), torch.tensor([[9.0, 9, 9]]))) * scale
    points = points[torch.randperm(len(points), generator=generator)]
    for radius, cap in ((0.3, 7), (20.0, 16), (1e-3, 40)):
        expected = _lowest_index_first(points, radius * scale, cap)
        edges = radius_edges(points, radius * scale, cap)
        # Sums of squares in another order may round differently: compare the distances that were chosen.
        assert torch.equal(edges[1], expected[1])
        rows = []
        for s, d in (edges, expected):
            length = (points[s] - points[d]).norm(dim=1)
            rows.append(length[torch.argsort(d * 100 * scale + length)])
        torch.testing.assert_close(rows[0], rows[1], rtol=1e-5, atol=0.0)


def test_no_neighbour_at_all() -> None:
    assert radius_edges(torch.rand(1, 3), 1.0, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1e-6, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1.0, 0).shape == (2, 0)


def test_positions_that_are_not_finite_are_refused() -> None:
    points, offsets, _ = _union()
    points[3, 1] = float("nan")
    with pytest.raises(ValueError, match="1 of 139 positions are NaN or infinite"):
        batched_radius_edges(points, offsets, RADII, 4)


@pytest.mark.gpu
def test_codes_are_captured_in_a_cuda_graph() -> None:
    points, offsets, member = _union(5)
    device = torch.device("cuda")
    held, member, radii = points.to(device), member.to(device), RADII.to(device)
    neighbour_codes(held, member, radii, 4)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        codes = neighbour_codes(held, member, radii, 4)
    moved = points.flip(1) * 0.9
    held.copy_(moved)
    graph.replay()
    assert torch.equal(_edges(codes.cpu(), len(points)), batched_radius_edges(moved, offsets, RADII, 4))
