"""The step's arrays give what the template gives."""

from __future__ import annotations

import numpy as np
import torch
from helpers.bodies import neural_model

from gausim.models.template.reduced import reduced_step


@torch.no_grad()
def test_arrays_give_energy_and_damping() -> None:
    part = neural_model().modal_scene(0)
    arrays, numbers = reduced_step(part)
    z = torch.randn(3, len(part.stiffness), generator=torch.Generator().manual_seed(0)).double()
    gradient = np.einsum("ncm,sm->snc", arrays["cells"], z.numpy()).reshape(3, -1, 3, 3)
    small = (gradient + gradient.swapaxes(-1, -2)) / 2
    green = small + gradient.swapaxes(-1, -2) @ gradient / 2
    shear, bulk = arrays["moduli"].T / 2
    whole, linear = (shear * (e**2).sum((-1, -2)) + bulk * np.trace(e, axis1=-2, axis2=-1) ** 2 for e in (green, small))
    expected = part.nonlinear.potential(part.nonlinear.strain_state(z), part.factor)
    np.testing.assert_allclose((whole - linear).sum(-1), expected.numpy(), rtol=1e-4)
    again = arrays["drag"] + numbers["viscosity"] * arrays["stiffness"]
    again = again + numbers["rate"] * (part.inertia - part.mass).numpy()
    np.testing.assert_allclose(again, part.damping.numpy(), rtol=1e-6, atol=1e-9)
