"""The step's tables give what the template gives."""

from __future__ import annotations

import numpy as np
import torch
from helpers.bodies import neural_model

from gausim.models.template.reduced import reduced_step


@torch.no_grad()
def test_energy_of_finite_strain_is_a_polynomial() -> None:
    part = neural_model().modal_scene(0)
    arrays, numbers = reduced_step(part)
    z = torch.randn(3, len(part.stiffness), generator=torch.Generator().manual_seed(0)).double()
    rows, columns = np.tril_indices(z.shape[1])
    pairs = z[:, rows] * z[:, columns] * torch.where(torch.tensor(rows == columns), 0.5, 1.0)
    table = torch.zeros(len(rows), len(rows), dtype=torch.float64)
    table[np.tril_indices(len(rows))] = torch.from_numpy(arrays["quadratic"]).double()
    table = table + table.tril(-1).mT
    mixed = torch.from_numpy(arrays["mixed"]).double()
    energy = ((z @ mixed) * pairs).sum(-1) + 0.5 * ((pairs @ table) * pairs).sum(-1)
    expected = part.nonlinear.potential(part.nonlinear.strain_state(z), part.factor)
    torch.testing.assert_close(energy, expected, rtol=1e-4, atol=1e-6)
    again = arrays["drag"] + numbers["viscosity"] * arrays["stiffness"]
    again = again + numbers["rate"] * (part.inertia - part.mass).numpy()
    np.testing.assert_allclose(again, part.damping.numpy(), rtol=1e-6, atol=1e-9)
