"""Rollouts of optimiser steps as CUDA graphs."""

from functools import partial
from typing import Any

import pytest
import torch
from helpers.meta_device import asking_nothing
from helpers.sway import ELASTIC, blobs, real_module, sample
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile

from gausim.kernels.operations import plain_forms
from gausim.losses.objective import Objective
from gausim.models.template.material import MaterialTemplate
from gausim.models.template.template import RestTemplate
from gausim.training.graphed import GraphedRollouts, _Stretch
from gausim.training.module import GausSimModule

OBJECTIVE = Objective(static_weight=0.0, backprop_steps=0)
MATERIAL = partial(MaterialTemplate, modes=6)
TEMPLATES = pytest.mark.parametrize("template", [RestTemplate, ELASTIC, MATERIAL])


def module_on(device: str, **options: Any) -> GausSimModule:
    module = real_module(parts={"objective": OBJECTIVE}, **options).to(device)
    module.images.renderer = blobs
    return module


def optimised(module: GausSimModule, updates: int = 1) -> tuple[list[dict[str, float]], dict[str, Tensor]]:
    """Metrics of every update, and the loss gradients of the last one."""
    device = next(module.parameters()).device
    samples, optimizer = [sample(0).to(device), sample(0).to(device)], module.configure_optimizers()
    metrics = [module.optimise(samples, optimizer, torch.Generator().manual_seed(n)) for n in range(updates)]
    return metrics, {name: p.grad for name, p in module.named_parameters() if p.grad is not None}


def test_a_rollout_from_tensors_to_tensors_has_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the capture, which needs a device."""
    expected, gradients = optimised(module_on("cpu", template=ELASTIC), 3)
    captures: list[int] = []

    def captured(stretch: nn.Module, given: Any, **options: Any) -> Any:
        captures.append(len(given))
        returned = [stretch(*given)]  # as a capture does: its rollouts must leave no trace in the input statistics

        def replay(*own: Tensor) -> tuple[Tensor, ...]:
            made = stretch(*own)
            for earlier, new in zip(returned[-1], made, strict=True):
                earlier.data.copy_(new)  # as a replay does: what it returned before is overwritten
            returned.append(made)
            return made

        return replay

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", captured)
    monkeypatch.setattr(GraphedRollouts, "serves", True)
    found, own = optimised(module_on("cpu", template=ELASTIC), 3)
    assert captures == [2]  # once for three updates
    assert found == expected
    for name, gradient in own.items():  # what is not used has zeros instead of none
        assert torch.equal(gradient, gradients.get(name, torch.zeros_like(gradient)))


def traced(device: str, template: Any) -> tuple[_Stretch, list[Tensor], list[Tensor]]:
    """Two steps of two members, their initial positions, and all that they are differentiated by."""
    model = module_on("cpu", template=template, edges="rest").simulator.to(device)
    batch = model.batch((0, 0))
    given = [batch.rest.clone().requires_grad_() for _ in range(2)]
    return _Stretch(model, batch, 2), given, [*given, *(p for p in model.parameters() if p.requires_grad)]


@TEMPLATES
def test_a_rollout_and_its_backward_pass_ask_the_device_nothing(template: Any) -> None:
    """Preparation included, for a graph captures all three."""
    stretch, given, trained = traced("meta", template)
    with asking_nothing(watched=False):
        stretch(*given)  # what a batch keeps from its first use on
    with asking_nothing():
        made = [x for x in stretch(*given) if x.requires_grad]
        found = torch.autograd.grad(made, trained, [torch.empty_like(x) for x in made], allow_unused=True)
    assert sum(gradient is not None for gradient in found) > len(trained) / 2


@TEMPLATES
def test_no_operation_of_a_backward_pass_reads_a_number(template: Any) -> None:
    """Of those within ATen, too, which tensors without values pass by: the gradient of a trace is one."""
    stretch, given, trained = traced("cpu", template)
    stretch(*given)  # what a batch keeps from its first use on
    with plain_forms(), profile(activities=[ProfilerActivity.CPU]) as seen:
        made = [x for x in stretch(*given) if x.requires_grad]
        torch.autograd.grad(made, trained, [torch.ones_like(x) for x in made], allow_unused=True)
    read = [event.cpu_parent.cpu_parent for event in seen.events() if event.name == "aten::_local_scalar_dense"]
    assert {parent.name for parent in read} <= {"aten::linalg_lu_solve"}  # which checks its pivots on the CPU only


@pytest.mark.gpu
@TEMPLATES
def test_gpu_replays_have_the_losses_and_gradients_of_the_steps(template: Any) -> None:
    expected, gradients = optimised(module_on("cuda", template=template, edges="rest", cuda_graph=False), 3)
    module = module_on("cuda", template=template, edges="rest", cuda_graph=True)
    assert module.graphs.serves
    found, own = optimised(module, 3)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-3)
    for name, gradient in own.items():
        truth = gradients.get(name, torch.zeros_like(gradient))
        torch.testing.assert_close(gradient, truth, atol=1e-3 * float(truth.abs().max()), rtol=1e-3, msg=name)
