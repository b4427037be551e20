"""What the simulator does with a template and what it shows to the network."""

from __future__ import annotations

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.models.template.template import PreparedTemplate, Template, TemplateState


class _Fixed(PreparedTemplate):
    """The same state, whatever the motion."""

    def __init__(self, state) -> None:
        self.state = state

    def __call__(self, motion, load=None):
        return self.state


class _Given(Template):
    """A fixed random configuration of the finest units."""

    def __init__(self, hierarchies, finest, *, conserve_volume, attributes, frames) -> None:
        super().__init__()
        level = hierarchies[0].levels[finest]
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(level.count, 3, 4, generator=generator, dtype=torch.float64) * ~level.pinned[:, None, None]
        self.state = TemplateState(level.rest + 0.1 * noise[..., 3], torch.eye(3) + 0.2 * noise[..., :3])

    def prepare(self, batch, units):
        return _Fixed(self.state)


@torch.no_grad()
def test_gradients_act_on_the_template_configuration() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene, predicted_levels=(1,), graph_radii=(0.4,), template=_Given, output_scale=5.0)
    model.log_density[0].zero_()
    step = model.step(model.batch((0,)), make_state(scene))
    hierarchy, template = model.hierarchies[0], model.template.state
    level, unit = hierarchy.levels[1], hierarchy.ancestor(0, 1)
    rest = scene.means[hierarchy.kernels]
    own = step.predicted[0]
    assert float((own - torch.eye(3)).abs().max()) > 0.05
    for k, c in enumerate(unit.tolist()):
        expected = rest[k]
        if not level.pinned[c]:
            root = rest[level.root[c]]
            centre = root + own[c] @ (template.positions[c] - root)
            expected = centre + own[c] @ template.deformation_gradients[c] @ (
                rest[k] - level.rest[c]
            )  # the template deforms first
            u, _, vh = torch.linalg.svd(template.deformation_gradients[c])
            w, _, xh = torch.linalg.svd(own[c])
            assert torch.allclose(step.deformation_gradients[c], own[c] @ template.deformation_gradients[c], atol=1e-12)
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
    assert torch.equal(finest, model.template.state.positions)
    parent = model.hierarchies[0].levels[1].parent
    for c in range(len(target)):
        weight = fine.mass[parent == c, None]
        assert torch.allclose(target[c], (weight * finest[parent == c]).sum(0) / coarse.mass[c])


@pytest.mark.parametrize("coarse", [False, True])
@torch.no_grad()
def test_the_network_sees_accelerations_and_velocities_in_diagonals(coarse) -> None:
    scene, gravity = make_scene(90, dtype=torch.float64), torch.tensor([0.5, 0.0, -4.0], dtype=torch.float64)
    model = make_model(scene, coarse_inputs=coarse, gravity=gravity.tolist(), output_scale=5.0, edges="rest")
    nodes, edges = [], []
    model.predictor.node_normaliser.register_forward_pre_hook(lambda _, inputs: nodes.append(inputs[0]))
    model.predictor.edge_normaliser.register_forward_pre_hook(lambda _, inputs: edges.append(inputs[0]))
    state = make_state(scene)
    step = model.step(model.batch((0,)), state)

    hierarchy, dt = model.hierarchies[0], 1 / 24.0
    mass = model.masses(model.batch((0,)))[0]

    def centres(values, number):
        unit = hierarchy.ancestor(0, number)
        rows = [unit == c for c in range(hierarchy.levels[number].count)]
        x = values[hierarchy.kernels]
        return torch.stack([(mass[r, None] * x[r]).sum(0) / mass[r].sum() for r in rows])

    rest, now, before = ({n: centres(v, n) for n in (1, 2)} for v in (scene.means, state.positions, state.previous))
    root = scene.means[hierarchy.kernels][hierarchy.levels[2].root]
    after = root + (step.predicted[0] @ (rest[2] - root)[..., None])[..., 0]
    size, parent = hierarchy.diagonal, hierarchy.levels[1].parent
    # Top level: the root does not accelerate, so gravity alone; velocity against a point that stands still.
    assert torch.allclose(nodes[0][:, :3], (gravity / size).expand(len(root), 3))
    assert torch.allclose(nodes[0][:, 3:6], (now[2] - before[2]) / dt / size)
    inertial = gravity - (after - 2 * now[2] + before[2]) / dt**2
    assert torch.allclose(nodes[1][:, :3], inertial[parent] / size, atol=1e-9)
    carried = (step.predicted[0][parent] @ (rest[1] - rest[2][parent])[..., None])[..., 0]
    local = carried if coarse else now[1] - now[2][parent]
    assert torch.allclose(nodes[1][:, 3:6], (local - (before[1] - before[2][parent])) / dt / size, atol=1e-9)
    density = torch.stack(
        [mass[hierarchy.ancestor(0, 1) == c].sum() / hierarchy.levels[1].volume[c] for c in range(len(parent))]
    )
    assert torch.allclose(nodes[1][:, 6], density.log())
    source, destination = model.batch((0,)).levels[1].rest_edges
    current = after[parent] + carried if coarse else now[1]
    offset = current[destination] - current[source]
    ratio = offset.norm(dim=-1) / (rest[1][destination] - rest[1][source]).norm(dim=-1)
    assert torch.allclose(edges[1][:, 0], ratio, rtol=1e-6)
    earlier = before[1][destination] - before[1][source]
    assert torch.allclose(edges[1][:, 4:7], (offset - earlier) / dt / size, atol=1e-9)
