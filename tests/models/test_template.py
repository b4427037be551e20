"""What the simulator does with a template and what it shows to the network."""

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.models.step import predictor
from gausim.models.step.features import network_inputs
from gausim.models.template.template import PreparedTemplate, Template, local_means


class _Fixed(PreparedTemplate):
    """The same state, whatever the motion."""

    def __init__(self, state) -> None:
        self.state = state

    def __call__(self, motion):
        return self.state


class _Given(Template):
    """A fixed random configuration of the finest units."""

    def __init__(self, hierarchies, finest, *, conserve_volume, attributes, frames) -> None:
        super().__init__()
        level = hierarchies[0].levels[finest]
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(level.count, 3, 4, generator=generator, dtype=torch.float64) * ~level.pinned[:, None, None]
        self.state = level.rest + 0.1 * noise[..., 3], torch.eye(3) + 0.2 * noise[..., :3]

    def prepare(self, batch, units):
        return _Fixed(self.state)

    def basis(self, scene_id):
        raise NotImplementedError


@torch.no_grad()
def test_gradients_act_on_the_template_configuration() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene, predicted_levels=(1,), graph_radii=(0.4,), template=_Given, output_scale=5.0)
    model.log_density[0].zero_()
    step = model.step(model.batch((0,)), make_state(scene))
    hierarchy, (positions, gradients) = model.hierarchies[0], model.template.state
    level, unit = hierarchy.levels[1], hierarchy.ancestor(0, 1)
    rest = scene.means[hierarchy.kernels]
    own = step.predicted[0]
    assert float((own - torch.eye(3)).abs().max()) > 0.05
    for k, c in enumerate(unit.tolist()):
        expected = rest[k]
        if not level.pinned[c]:
            root = rest[level.root[c]]
            centre = root + own[c] @ (positions[c] - root)
            expected = centre + own[c] @ gradients[c] @ (rest[k] - level.rest[c])  # the template deforms first
            u, _, vh = torch.linalg.svd(gradients[c])
            w, _, xh = torch.linalg.svd(own[c])
            assert torch.allclose(step.deformation_gradients[c], own[c] @ gradients[c], atol=1e-12)
            assert torch.allclose(step.rotations[c], w @ xh @ u @ vh, atol=1e-9)
        assert torch.allclose(step.positions[hierarchy.kernels[k]], expected, atol=1e-12)


@torch.no_grad()
def test_coarse_template_positions_are_the_centres_of_mass_of_their_children() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene, template=_Given)
    seen = []

    def nothing(level, unit, above, target, position):
        seen.append((unit, target))
        return torch.zeros(level.count, 11, dtype=torch.float64)

    model.predictor.forward = nothing
    model.step(model.batch((0,)), make_state(scene))
    (coarse, target), (fine, finest) = seen
    assert torch.equal(finest, model.template.state[0])
    parent = model.hierarchies[0].levels[1].parent
    for c in range(len(target)):
        weight = fine.mass[parent == c, None]
        assert torch.allclose(target[c], (weight * finest[parent == c]).sum(0) / coarse.mass[c])


@pytest.mark.parametrize("coarse", [False, True])
@torch.no_grad()
def test_inputs_are_made_of_the_centres_of_mass_and_of_the_solved_parents(coarse, monkeypatch) -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene, coarse_inputs=coarse, output_scale=5.0, edges="rest")
    asked = []

    def inputs(*given, **options):
        asked.append((given, options["coarse"]))
        return network_inputs(*given, **options)

    monkeypatch.setattr(predictor, "network_inputs", inputs)
    state = make_state(scene)
    step = model.step(model.batch((0,)), state)
    hierarchy, mass = model.hierarchies[0], model.masses(model.batch((0,)))[0]
    above = root = scene.means[hierarchy.kernels][hierarchy.levels[2].root]
    for number, (given, coarsely), gradient in zip((2, 1), asked, step.predicted, strict=True):
        unit, target, parents, edges, size, dt, _ = given
        members = [hierarchy.ancestor(0, number) == c for c in range(hierarchy.levels[number].count)]
        for found, values in ((unit.rest, scene.means), (unit.now, state.positions), (unit.before, state.previous)):
            x = values[hierarchy.kernels]
            expected = torch.stack([(mass[own, None] * x[own]).sum(0) / mass[own].sum() for own in members])
            torch.testing.assert_close(found, expected)
        density = torch.stack([mass[own].sum() for own in members]) / hierarchy.levels[number].volume
        torch.testing.assert_close(unit.log_density.exp(), density)
        torch.testing.assert_close((target, parents.after[parents.index]), (unit.rest, above))
        assert coarsely == (coarse and number == 1)
        assert torch.equal(edges, model.batch((0,)).levels[2 - number].rest_edges)
        torch.testing.assert_close((size, dt), tuple(torch.full_like(size, x) for x in (hierarchy.diagonal, 1 / 24)))
        if number == 2:  # roots do not move
            assert all(torch.equal(x, root) for x in (parents.rest, parents.now, parents.before))
            after = root + (gradient @ (unit.rest - root)[..., None])[..., 0]
            above, coarser = after[hierarchy.levels[1].parent], unit
        else:
            torch.testing.assert_close((parents.now, parents.before), (coarser.now, coarser.before))


def test_maps_of_material_leave_out_what_single_units_have() -> None:
    """A step of stiffness along a rod stays, a factor on every other point goes; what is not known does not count."""
    points = torch.zeros(3000, 3, dtype=torch.float64)
    points[:, 0] = torch.linspace(0, 1, 3000)
    known = points[:, 0] < 0.9
    step, single = 4.0 ** (points[:, 0] > 0.5).double(), 3.0 ** (torch.arange(3000) % 2 - 0.5)
    found = local_means(torch.where(known, step * single, torch.nan), points, known, 0.05)
    torch.testing.assert_close(found, local_means(step, points, known, 0.05), rtol=1e-2, atol=0)
    torch.testing.assert_close(found[[450, 2400, 2999]], torch.tensor([1.0, 4.0, 4.0]).double(), rtol=1e-2, atol=0)
    assert float(found[1500]) == pytest.approx(2.0, rel=1e-2)
