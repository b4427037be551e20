from __future__ import annotations

from functools import partial

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state
from torch import Tensor, nn
from torch.func import functional_call

from gausim.core import SimState
from gausim.models.template.elastic import ElasticTemplate


class _Stepper(nn.Module):
    """The step as a module's forward, so that its parameters can be given from outside."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, positions: Tensor, previous: Tensor, force: Tensor) -> tuple[Tensor, ...]:
        step = self.model.step(self.model.batch((0,)), SimState(positions, previous), force)
        return step.positions, step.deformation_gradients, step.rotations, step.momentum


def _function(stepper: _Stepper, names: list[str], outputs: tuple[int, ...]):
    def run(positions: Tensor, previous: Tensor, force: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        result = functional_call(stepper, dict(zip(names, values, strict=True)), (positions, previous, force))
        return tuple(result[i] for i in outputs)

    return run


@pytest.mark.parametrize("coarse", [False, True])
def test_gradcheck_of_the_whole_step(coarse) -> None:
    scene = make_scene(22, dtype=torch.float64, spare=2)
    model = make_model(
        scene, radii=(0.3, 0.6), edges="union", rest_inputs=coarse, coarse_inputs=coarse, attributes=2, output_scale=2.0
    )
    names = ["model.log_density.0", "model.attributes.0", "model.predictor.network.decoder.4.weight"]
    _gradcheck(model, scene, make_state(scene), names, outputs=(0, 1, 2, 3))


def test_gradcheck_of_the_whole_step_with_the_elastic_template() -> None:
    scene = make_scene(22, dtype=torch.float64, spare=2)
    template = partial(ElasticTemplate, modes=4, neighbours=6, geometric=0.01)  # held by no bound
    model = make_model(scene, radii=(0.3, 0.6), edges="rest", attributes=2, template=template)
    with torch.no_grad():
        for name, p in model.template.named_parameters():
            p.add_((0.0 if "gain" in name else 0.3) * torch.randn_like(p))
    own = ["stiffness", "spectrum", "mixing", "damping", "damping_mixing", "inertia_mixing", "gain"]
    names = ["model.log_density.0", "model.attributes.0", *(f"model.template.scenes.0.{n}" for n in own)]
    # The template's rotation only turns colours and is left out of the graph by design: output 2 is not checked.
    _gradcheck(model, scene, make_state(scene), names, outputs=(0, 1, 3))


def _gradcheck(model, scene, state, names: list[str], outputs: tuple[int, ...]) -> None:
    stepper = _Stepper(model)
    parameters = dict(stepper.named_parameters())
    force = torch.randn(scene.count, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    inputs = [state.positions, state.previous, force, *(parameters[n].detach() for n in names)]
    leaves = [x.clone().requires_grad_() for x in inputs]
    function = _function(stepper, names, outputs)
    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)
    total = sum(o.square().sum() for o in function(*leaves))
    for gradient in torch.autograd.grad(total, leaves):
        assert bool((gradient.abs() > 1e-9).any())  # every input matters: the check is not about zeros
