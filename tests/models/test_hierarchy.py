import pytest
import torch
from helpers.bodies import make_model, make_scene

from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.ops.covariance import kernel_volumes

RADII = (0.15, 0.35, 0.7)


def test_every_unit_has_one_parent_of_its_own_kind_and_volumes_add_up() -> None:
    scene = make_scene(120, dtype=torch.float64)
    hierarchy = build_hierarchy(scene, radii=RADII)
    counts = [level.count for level in hierarchy.levels]
    assert counts[0] == int(scene.simulated.sum()) and counts == sorted(set(counts), reverse=True)
    volume = kernel_volumes(scene.log_scales, scene.volume_scale)[scene.simulated]
    for fine, coarse in zip(hierarchy.levels[:-1], hierarchy.levels[1:], strict=True):
        assert fine.parent.shape == (fine.count,)
        assert set(fine.parent.tolist()) == set(range(coarse.count))  # each has a parent, no parent is empty
        assert torch.equal(coarse.pinned[fine.parent], fine.pinned)  # a cluster never mixes pinned and free
        summed = coarse.volume.new_zeros(coarse.count).index_add(0, fine.parent, fine.volume)
        assert torch.allclose(coarse.volume, summed)
        assert torch.allclose(coarse.volume.sum(), volume.sum(), rtol=1e-12)
    assert len(hierarchy.levels[-1].parent) == 0
    assert 0 < int(hierarchy.levels[-1].pinned.sum()) < hierarchy.levels[-1].count


@pytest.mark.parametrize("predicted", [[3, 2, 1], [0]])
def test_masses_add_up_level_by_level_with_random_densities(predicted) -> None:
    scenes = [make_scene(90, dtype=torch.float64), make_scene(60, seed=1, dtype=torch.float64)]
    model = make_model(scenes, radii=RADII, predicted_levels=predicted, graph_radii=[0.6] * len(predicted))
    batch = model.batch((0, 1, 0))
    mass, log_density = model.masses(batch)
    assert float(log_density.detach().std()) > 0.1
    assert torch.allclose(mass, batch.volume * log_density.exp())
    positions = batch.rest + torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(2)).to(batch.rest)
    prepared = model.prepare(batch)
    for level, unit, centre in zip(
        batch.levels, prepared.levels, prepared.per_level(prepared.finest(positions)), strict=True
    ):
        assert torch.allclose(unit.mass.sum(), mass.sum(), rtol=1e-12)
        assert torch.allclose(level.volume.sum(), batch.volume.sum(), rtol=1e-12)
        for c in range(level.count):
            members = level.unit_of_kernel == c
            assert torch.allclose(unit.mass[c], mass[members].sum())
            assert torch.allclose(unit.log_density[c].exp(), mass[members].sum() / batch.volume[members].sum())
            for found, values in ((centre, positions), (unit.rest, batch.rest)):
                weighted = (mass[:, None] * values[batch.simulated])[members].sum(0) / mass[members].sum()
                assert torch.allclose(found[c], weighted)


def test_centres_are_volume_weighted_and_roots_the_nearest_pinned_kernel() -> None:
    scene = make_scene(90, dtype=torch.float64)
    hierarchy = build_hierarchy(scene, radii=RADII)
    base = hierarchy.levels[0]
    assert torch.equal(base.rest, scene.means[hierarchy.kernels])
    for number in range(4):
        ancestor, level = hierarchy.ancestor(0, number), hierarchy.levels[number]
        for c in range(level.count):
            members = ancestor == c
            weight = base.volume[members, None]
            assert torch.allclose(level.rest[c], (weight * base.rest[members]).sum(0) / weight.sum())
    assert torch.equal(hierarchy.ancestor(1, 3)[hierarchy.ancestor(0, 1)], hierarchy.ancestor(0, 3))
    free = [int((~level.pinned).sum()) for level in hierarchy.levels]
    assert hierarchy.predictions([2, 1]) == free[2] + free[1]
    for level in hierarchy.levels:
        for c in range(level.count):
            distance = (base.rest - level.rest[c]).norm(dim=-1).masked_fill(~base.pinned, float("inf"))
            assert int(level.root[c]) == int(distance.argmin())
