"""Runs from machines whose eigenvectors have other signs."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers.sway import real_module, sample
from torch import Tensor

from gausim.models.initial_state import ModalInitialStates
from gausim.models.template import solid
from gausim.models.template.material import MaterialTemplate
from gausim.training.module import GausSimModule
from gausim.training.rollout import windows


def made() -> GausSimModule:
    template = partial(MaterialTemplate, modes=6)  # the elastic one fixes the signs of its modes
    return real_module((0, 0), template=template, states=partial(ModalInitialStates, in_diagonals=True))


@torch.no_grad()
def rolled(module: GausSimModule) -> Tensor:
    samples = [sample(0), sample(0)]
    batch = module.simulator.batch([0, 0])
    ((_, steps),) = windows(module.simulator, batch, module.method.initial(samples, batch), 4, 4)
    return torch.stack([step.positions for step in steps])


def test_a_run_moves_alike_where_eigenvectors_have_other_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    run = made().eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in run.named_parameters():
            if "template" in name or "velocity" in name:
                parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    expected, still = rolled(run), run.simulator.batch([0, 0]).rest

    def turned(own: Any, *given: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        values, vectors = own(*given, **options)
        return values, vectors * np.where(np.arange(vectors.shape[1]) % 2, -1.0, 1.0)

    monkeypatch.setattr(solid, "lowest", partial(turned, solid.lowest))
    other = made().eval()
    assert not torch.allclose(*(m.initial_states.signature_0 for m in (run, other)))
    other.load_state_dict(run.state_dict())
    found = rolled(other)
    assert float((found - expected).norm() / (expected - still).norm()) < 1e-4
    other.load_state_dict({n: x for n, x in other.state_dict().items() if "signature" not in n})  # an older run
    torch.testing.assert_close(rolled(other), found)
