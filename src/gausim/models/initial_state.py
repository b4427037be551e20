"""Trainable initial states: x_{-1} of every training sequence (METHOD section 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.models.step.simulator import GausSim

TINY = 1e-12


class FreeInitialStates(nn.Module):
    """Per-kernel initial states: x_{-1} = X + offset, K x 3 parameters per sequence, initially zero."""

    def __init__(self, model: GausSim, scene_of_sequence: Sequence[int]) -> None:
        """Creates one parameter per sequence; pinned and never-simulated kernels stay at X."""
        super().__init__()
        self.scene_of_sequence = tuple(scene_of_sequence)
        self._rest = [s.means for s in model.scenes]
        self._diagonal = [h.diagonal for h in model.hierarchies]
        self._free = [(s.simulated & ~s.pinned)[:, None] for s in model.scenes]
        self.offset = nn.ParameterList(torch.zeros_like(self._rest[i]) for i in self.scene_of_sequence)

    def previous(self, sequence_id: int) -> Float[Tensor, "K 3"]:
        """x_{-1} of one sequence [scene units]; the parameter is in diagonals of the scene."""
        scene, offset = self.scene_of_sequence[sequence_id], self.offset[sequence_id]
        rest, free = self._rest[scene].to(offset), self._free[scene].to(offset.device)
        return rest + torch.where(free, offset * self._diagonal[scene], torch.zeros_like(offset))

    def reach(self, change: float) -> float:
        """Displacement of x_{-1} when every component of its parameter changes by ``change`` [diagonals]."""
        return change


class ModalInitialStates(nn.Module):
    """Modal initial states: x_{-1} = X - sum_m v_m phi_m(X), with M amplitudes v_m of template modes per sequence.

    The velocity field of an elastic body is smooth; most per-kernel offsets would remain undetermined by 16 frames.
    """

    def __init__(self, model: GausSim, scene_of_sequence: Sequence[int], *, in_diagonals: bool = False) -> None:
        """Creates one parameter per sequence, initially zero.

        Args:
            model: its template must have a basis (:class:`gausim.models.template.elastic.ElasticTemplate`).
            scene_of_sequence: index of the scene of each sequence.
            in_diagonals: normalise phi_m to a largest kernel displacement of one diagonal, so that one learning rate
                means the same motion for every object and template; else v_m is in the template's units.
        """
        super().__init__()
        self.scene_of_sequence = tuple(scene_of_sequence)
        self._rest = [s.means for s in model.scenes]
        self._diagonal = [h.diagonal for h in model.hierarchies]
        self._basis = []
        for scene_id, diagonal in enumerate(self._diagonal):
            motions = model.smooth_motions(scene_id)
            if motions is None:
                raise ConfigError(
                    f"model.initial_states: {type(model.template).__name__} carries no basis of motions. "
                    "Use gausim.models.initial_state.FreeInitialStates with it."
                )
            basis = motions.kernels / motions.sizes
            most = basis.norm(dim=1).amax(0).clamp_min(TINY)
            self._basis.append(basis * (diagonal / most) if in_diagonals else basis)
        self.velocity = nn.ParameterList(torch.zeros(self._basis[i].shape[-1]) for i in self.scene_of_sequence)

    def previous(self, sequence_id: int) -> Float[Tensor, "K 3"]:
        """x_{-1} of one sequence [scene units]."""
        scene, velocity = self.scene_of_sequence[sequence_id], self.velocity[sequence_id]
        return self._rest[scene].to(velocity) - self._basis[scene].to(velocity) @ velocity

    def reach(self, change: float) -> float:
        """Displacement of x_{-1} when v_0 changes by ``change``, smallest over the scenes [diagonals]."""
        moved = [float(basis[..., 0].norm(dim=1).max()) for basis in self._basis]
        return change * min(most / diagonal for most, diagonal in zip(moved, self._diagonal, strict=True))
