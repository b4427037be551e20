from __future__ import annotations

import pytest
import torch

from gausim.ops.neighbours import combine_edges, radius_edges


def _brute_force(points: torch.Tensor, radius: float, cap: int) -> set[tuple[int, int]]:
    distance = torch.cdist(points, points)
    edges = set()
    for d in range(len(points)):
        near = [int(s) for s in distance[d].argsort() if s != d and distance[d, s] < radius]
        edges |= {(s, d) for s in near[:cap]}
    return edges


def _pairs(edges: torch.Tensor) -> list[tuple[int, int]]:
    return [(int(s), int(d)) for s, d in edges.T]


@pytest.mark.parametrize(("radius", "cap"), [(0.5, 100), (0.8, 4), (0.01, 4)])
def test_equals_brute_force_and_is_sorted(radius: float, cap: int) -> None:
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pairs = _pairs(radius_edges(points, radius, cap))
    assert set(pairs) == _brute_force(points, radius, cap) and len(set(pairs)) == len(pairs)
    assert pairs == sorted(pairs, key=lambda e: (e[1], e[0]))


def test_coincident_points_get_no_self_edges_and_no_more_than_the_cap() -> None:
    source, destination = radius_edges(torch.ones(9, 3), 0.5, 4)
    assert bool((source != destination).all())
    assert torch.bincount(destination, minlength=9).tolist() == [4] * 9


def test_combine_edges_is_the_set_operation() -> None:
    generator = torch.Generator().manual_seed(1)
    a, b = (radius_edges(torch.rand(20, 3, generator=generator), 0.6, 5) for _ in range(2))
    expected = {"union": set(_pairs(a)) | set(_pairs(b)), "intersection": set(_pairs(a)) & set(_pairs(b))}
    assert 0 < len(expected["intersection"]) < len(expected["union"])
    for rule, wanted in expected.items():
        pairs = _pairs(combine_edges(a, b, 20, rule=rule))
        assert pairs == sorted(wanted, key=lambda e: (e[1], e[0]))
    with pytest.raises(ValueError, match="expected 'union' or 'intersection'"):
        combine_edges(a, b, 20, rule="either")
