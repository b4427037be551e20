"""Linear stability: eigenvalues of a simulator's step at rest."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

from gausim.core import SimState
from gausim.models.step.simulator import GausSim
from gausim.nn.mode import evaluating

# Rows of the Jacobian per backward pass, each in a copy of the scene.
COPIES = 24


def largest_eigenvalue(model: GausSim, scene_id: int) -> float:
    """Largest absolute eigenvalue of the step at rest; above 1, small motions grow.

    The step maps displacements (u_t, u_{t-1}) of the finest predicted units and their kernels to (u_{t+1}, u_t). Its
    Jacobian [[A, B], [I, 0]] over the units that are not pinned comes from automatic differentiation.
    """
    step = LinearStep(model, scene_id)
    count, blocks = step.count, step.rows()
    jacobian = np.block([[blocks[:, :count], blocks[:, count:]], [np.eye(count), np.zeros((count, count))]])
    return float(np.abs(np.linalg.eigvals(jacobian)).max())


class LinearStep:
    """Products with the Jacobian of the free units' step at rest."""

    def __init__(self, model: GausSim, scene_id: int) -> None:
        self._model, self._scene_id = model, scene_id
        level = model.batch((scene_id,)).levels[-1]
        self._free = level.free[:, 0].bool()
        self.count = 3 * int(self._free.sum())
        self._step = cache(self._linearised)  # one graph serves all products

    def _linearised(self, copies: int) -> tuple[Tensor, Tensor]:
        """Displacements (2, N, 3) of all units in so many copies of the scene, and the free ones after a step."""
        model = self._model
        with evaluating(model), torch.enable_grad():
            batch = model.batch((self._scene_id,) * copies)
            prepared, free = model.prepare(batch), self._free.repeat(copies)
            shifts = batch.rest.new_zeros(2, len(free), 3, requires_grad=True)
            kernels = (shifts * free[:, None]).index_select(1, batch.finest)
            state = SimState(batch.rest + kernels[0], batch.rest + kernels[1])
            return shifts, prepared.mean(model.step(batch, state, prepared=prepared).positions)[free]

    def _pull(self, weights: Tensor) -> np.ndarray:
        """weights^T [A, B] for every row of ``weights`` (copies, count)."""
        shifts, after = self._step(len(weights))
        (pulled,) = torch.autograd.grad(after, shifts, weights.view(-1, 3).to(after), retain_graph=True)
        rows = pulled[:, self._free.repeat(len(weights))].view(2, len(weights), self.count)
        return torch.cat((rows[0], rows[1]), 1).double().cpu().numpy()

    def rows(self) -> np.ndarray:
        """[A, B] (count, 2 count)."""
        identity = torch.eye(self.count, device=self._free.device)
        return np.concatenate([self._pull(part) for part in identity.split(COPIES)])
