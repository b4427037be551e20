"""Neighbours of disjoint unions: the search in a tree, the torch table and unions of edges."""

from __future__ import annotations

import pytest
import torch

from gausim.ops.neighbours import batched_radius_edges, combine_edges, combine_tables, neighbour_table, radius_edges

SIZES = (40, 1, 73, 0, 25)
RADII = torch.tensor([0.3, 0.5, 0.25, 1.0, 0.02])


def _union(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points of members that overlap in space, their offsets, and the member of every point."""
    points = torch.rand(sum(SIZES), 3, generator=torch.Generator().manual_seed(seed))
    sizes = torch.tensor(SIZES)
    offsets = torch.cat((torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)))
    return points, offsets, torch.arange(len(SIZES)).repeat_interleave(sizes)


def _as_edges(index: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    destination = torch.arange(len(index))[:, None].expand_as(index)
    return torch.stack((index[valid], destination[valid]))


def _grid() -> torch.Tensor:
    """Full of ties: at a cap of 8 most points choose among equally distant ones."""
    return torch.cartesian_prod(*[torch.arange(5.0)] * 3)


def _lowest_index_first(points: torch.Tensor, radius: float, cap: int) -> torch.Tensor:
    rows = []
    for d in range(len(points)):
        square = (points - points[d]).square().sum(1)
        near = [s for s in square.sort(stable=True).indices.tolist() if s != d and square[s] < radius**2]
        rows += [(s, d) for s in sorted(near[:cap])]
    return torch.tensor(rows).T


@pytest.mark.parametrize("cap", [1, 4, 200])
def test_a_union_is_its_members_side_by_side(cap: int) -> None:
    points, offsets, _ = _union()
    expected = []
    for low, high, radius in zip(offsets, offsets[1:], RADII, strict=False):
        if high > low:
            expected.append(radius_edges(points[low:high], float(radius), cap) + low)
    edges = batched_radius_edges(points, offsets, RADII, cap)
    assert edges.shape[1] > 50 and torch.equal(edges, torch.cat(expected, 1))


@pytest.mark.parametrize("cap", [1, 4, 200])
def test_the_table_of_torch_operations_holds_the_same_edges(cap: int, monkeypatch: pytest.MonkeyPatch) -> None:
    points, offsets, member = _union(1)
    monkeypatch.setattr("gausim.ops.neighbours.TABLE_ELEMENTS", 10 * len(points))  # ten rows at a time
    index, valid = neighbour_table(points, member, RADII, cap)
    assert index.shape == valid.shape == (len(points), cap)
    assert torch.equal(_as_edges(index, valid), batched_radius_edges(points, offsets, RADII, cap))
    own = torch.arange(len(points))[:, None].expand_as(index)
    assert torch.equal(index[~valid], own[~valid]) and not valid.all()
    assert (valid.long().diff(dim=1) <= 0).all()  # what is not valid stands last


@pytest.mark.parametrize("cap", [3, 8])
def test_ties_go_to_the_lower_index_in_both(cap: int) -> None:
    points = _grid()
    expected = _lowest_index_first(points, 2.5, cap)
    assert torch.equal(radius_edges(points, 2.5, cap), expected)
    table = neighbour_table(points, torch.zeros(len(points), dtype=torch.int64), torch.tensor([2.5]), cap)
    assert torch.equal(_as_edges(*table), expected)


def test_a_distance_equal_to_the_radius_is_no_edge() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0.5, 0]])
    assert radius_edges(points, 1.0, 5).tolist() == [[2, 1], [1, 2]]
    index, valid = neighbour_table(points, torch.zeros(3, dtype=torch.int64), torch.tensor([1.0]), 2)
    assert _as_edges(index, valid).tolist() == [[2, 1], [1, 2]]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_clumps_lines_and_outliers_equal_brute_force(scale: float) -> None:
    """Where the distance to the next neighbour jumps by orders of magnitude, from zero on."""
    generator = torch.Generator().manual_seed(2)
    clump = torch.rand(60, 3, generator=generator) * 1e-3 + 0.5
    line = torch.linspace(0, 1, 50)[:, None].expand(50, 3)
    same = torch.full((30, 3), 0.25)
    points = torch.cat((clump, line, same, torch.tensor([[9.0, 9, 9]]))) * scale
    points = points[torch.randperm(len(points), generator=generator)]
    for radius, cap in ((0.3, 7), (20.0, 16), (1e-3, 40)):
        expected = _lowest_index_first(points, radius * scale, cap)
        edges = radius_edges(points, radius * scale, cap)
        # Sums of squares in another order may round differently: compare the distances that were chosen.
        assert torch.equal(edges[1], expected[1])
        lengths = [(points[e[0]] - points[e[1]]).norm(dim=1) for e in (edges, expected)]
        rows = [
            torch.stack((e[1].double(), w.double()), 1)[torch.argsort(e[1] * 100 * scale + w)]
            for e, w in zip((edges, expected), lengths, strict=True)
        ]
        torch.testing.assert_close(rows[0], rows[1], rtol=1e-5, atol=0.0)


def test_no_neighbour_at_all() -> None:
    assert radius_edges(torch.rand(1, 3), 1.0, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1e-6, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1.0, 0).shape == (2, 0)


def test_what_is_wrong_is_named() -> None:
    points, offsets, _ = _union()
    with pytest.raises(ValueError, match="expected 6 ascending numbers from 0 to 139"):
        batched_radius_edges(points, offsets[:-1], RADII, 4)
    with pytest.raises(ValueError, match="expected 6 ascending numbers"):
        batched_radius_edges(points, offsets.flip(0), RADII, 4)
    points[3, 1] = float("nan")
    with pytest.raises(ValueError, match="1 of 139 positions are NaN or infinite"):
        batched_radius_edges(points, offsets, RADII, 4)


@pytest.mark.parametrize("rule", ["union", "intersection"])
def test_sorted_edges_and_tables_combine_to_the_same_set(rule: str) -> None:
    points, offsets, member = _union(3)
    moved = points + 0.05 * torch.rand(points.shape, generator=torch.Generator().manual_seed(4))
    a, b = (batched_radius_edges(x, offsets, RADII, 5) for x in (points, moved))
    sets = [set(zip(e[1].tolist(), e[0].tolist(), strict=True)) for e in (a, b)]
    expected = sorted(sets[0] | sets[1] if rule == "union" else sets[0] & sets[1])
    assert 0 < len(expected) != a.shape[1]
    edges = combine_edges(a, b, len(points), rule=rule)
    assert [(d, s) for s, d in edges.T.tolist()] == expected
    tables = [neighbour_table(x, member, RADII, k) for x, k in ((points, 5), (moved, 5))]
    index, valid = combine_tables(*tables, rule=rule)
    assert index.shape == (len(points), 10 if rule == "union" else 5)
    assert torch.equal(_as_edges(index, valid), edges)


def test_combining_refuses_unknown_rules() -> None:
    table = (torch.zeros(2, 1, dtype=torch.int64), torch.ones(2, 1, dtype=torch.bool))
    with pytest.raises(ValueError, match="expected 'union' or 'intersection'"):
        combine_tables(table, table, rule="either")


@pytest.mark.gpu
def test_the_table_is_captured_in_a_cuda_graph() -> None:
    points, offsets, member = _union(5)
    device = torch.device("cuda")
    held, member, radii = points.to(device), member.to(device), RADII.to(device)
    neighbour_table(held, member, radii, 4)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        index, valid = neighbour_table(held, member, radii, 4)
    moved = points.flip(1) * 0.9
    held.copy_(moved)
    graph.replay()
    assert torch.equal(_as_edges(index.cpu(), valid.cpu()), batched_radius_edges(moved, offsets, RADII, 4))
