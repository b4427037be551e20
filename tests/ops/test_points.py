"""Clusters, neighbours and selections of points."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from helpers.plain import plain_scene
from scipy.spatial.distance import pdist

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene
from gausim.ops.clustering import ball_clusters, k_means
from gausim.ops.neighbours import batched_radius_edges, coded_edges, neighbour_codes, no_edge, radius_edges
from gausim.ops.selection import HalfSpace, apply_masks, parse_half_space, require_pinned


def _count(labels: np.ndarray) -> int:
    return int(labels.max()) + 1


def _widest(points: np.ndarray, labels: np.ndarray) -> float:
    order = np.argsort(labels, kind="stable")
    members = np.split(points[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return max((float(pdist(m).max()) for m in members if len(m) > 1), default=0.0)


def _cloud(count: int = 150, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * (1.0, 0.5, 2.0)


def test_clusters_keep_their_diameter_under_permutation_and_find_clumps() -> None:
    points, diameter = _cloud(), 0.8
    labels = ball_clusters(points, diameter)
    assert sorted(set(labels)) == list(range(labels.max() + 1))
    assert _count(labels) < len(points)  # else the bound says nothing
    assert _widest(points, labels) <= diameter * (1 + 1e-9)
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(ball_clusters(points[order], diameter), labels[order])
    rng = np.random.default_rng(2)
    truth = np.repeat(np.arange(4), 6)
    points = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5.0]])[truth] + rng.uniform(-0.1, 0.1, (24, 3))
    labels = ball_clusters(points, 1.0)
    assert labels.max() == 3 and ball_clusters(np.ones((1, 3)), 0.5).tolist() == [0]
    assert np.array_equal(labels[:, None] == labels, truth[:, None] == truth)


def test_k_means_finds_groups_and_is_a_fixed_point() -> None:
    generator = np.random.default_rng(0)
    middles = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [4, 4, 4]])
    points = np.concatenate([m + 0.3 * generator.standard_normal((30, 3)) for m in middles])
    centres = k_means(points, 5)
    groups = np.array([points[30 * i : 30 * (i + 1)].mean(0) for i in range(5)])
    nearest = np.linalg.norm(centres[:, None] - groups[None], axis=-1)
    assert sorted(nearest.argmin(1)) == list(range(5))
    assert nearest.min(1).max() < 1e-12  # each centre is the mean of the points nearest to it
    order = generator.permutation(len(points))
    assert np.allclose(np.sort(k_means(points[order], 5), axis=0), np.sort(centres, axis=0))
    assert np.array_equal(k_means(points[:4], 7), points[:4])


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


def test_the_radius_is_open_and_may_hold_no_neighbour() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0.5, 0]])
    assert radius_edges(points, 1.0, 5).tolist() == [[2, 1], [1, 2]]
    codes = neighbour_codes(points, torch.zeros(3, dtype=torch.int64), torch.tensor([1.0]), 2)
    assert _edges(codes, 3).tolist() == [[2, 1], [1, 2]]
    assert radius_edges(torch.rand(1, 3), 1.0, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1e-6, 4).shape == (2, 0)
    assert radius_edges(torch.rand(9, 3), 1.0, 0).shape == (2, 0)
    points, offsets, _ = _union()
    points[3, 1] = float("nan")
    with pytest.raises(ValueError, match="1 of 139 positions are NaN or infinite"):
        batched_radius_edges(points, offsets, RADII, 4)


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


@pytest.fixture
def scene() -> GaussianScene:
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [0.0, 2.0, 0.4], [1.0, 2.0, 0.6]])
    sh = torch.zeros(4, 1, 3)
    sh[2, 0, 1] = 1.0  # one greenish kernel
    return plain_scene(means, sh=sh)


def selected(mask: torch.Tensor) -> list[int]:
    return mask.nonzero()[:, 0].tolist()


def test_half_spaces_become_masks(scene: GaussianScene) -> None:
    assert selected(HalfSpace(2, below=0.4)(scene)) == [0, 1]
    assert selected(HalfSpace(2, above=0.3)(scene)) == [2, 3]
    assert selected(HalfSpace(2, below=0.5, above=0.1)(scene)) == [1, 2]
    assert selected(parse_half_space("y=1.5")(scene)) == [0, 1]
    assert selected(parse_half_space(" above  y = 1.5 ")(scene)) == [2, 3]
    marked = apply_masks(scene, simulated=HalfSpace(0, below=0.5), pinned=HalfSpace(2, below=0.3))
    assert selected(marked.simulated) == [0, 2]
    assert selected(marked.pinned) == [0]
    assert selected(apply_masks(marked, foreground=marked.pinned).pinned) == [0]
    assert selected(apply_masks(marked, simulated=HalfSpace(2, above=0.3)).pinned) == []
    with pytest.raises(SceneError, match=r"'pinned'.*none of 4 kernels.*z 0\.\.0\.6"):
        apply_masks(scene, pinned=parse_half_space("z=-1"))


@pytest.mark.parametrize("text", ["0.33", "w=1", "left z=1", "z=", "z<1", "z=1.2.3"])
def test_half_space_of_another_form_is_refused(text: str) -> None:
    with pytest.raises(SceneError, match="AXIS=VALUE"):
        parse_half_space(text)


def test_what_nothing_holds_and_what_nothing_frees_is_refused(scene: GaussianScene) -> None:
    held = apply_masks(scene, pinned=parse_half_space("z=0.1"))
    assert require_pinned(held) is held
    with pytest.raises(SceneError, match="every simulated kernel is pinned"):
        require_pinned(dataclasses.replace(scene, pinned=scene.simulated))
    with pytest.raises(SceneError, match="mask 'simulated' marks no kernel"):
        require_pinned(dataclasses.replace(scene, simulated=scene.pinned))
    with pytest.raises(SceneError, match="no kernel is pinned") as caught:
        require_pinned(scene)
    proposed = re.findall(r"below z=[-.0-9e]+", str(caught.value))
    assert len(proposed) == 2  # one for either remedy
    assert {tuple(selected(parse_half_space(text)(scene))) for text in proposed} == {(0,)}
