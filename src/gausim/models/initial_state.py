"""Trainable initial states: x_{-1} of every training sequence (METHOD section 4), and x_0 of free bodies."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, HandPath, SimState
from gausim.models.reference.surroundings import SceneSurroundings
from gausim.models.step.simulator import GausSim
from gausim.ops.rotation import rotation_of

# Numbers of a free body's start: translation [diagonals], rotation [radian], velocity and spin per frame.
START = 12


class InitialStates(nn.Module, ABC):
    """Initial states of the training sequences, one trained parameter each.

    x_0 is the rest state and x_{-1} = X - o, with o the motion that a subclass describes. A free body begins somewhere
    and moves as a whole, with t, v in diagonals:

        x_0 = R(theta) (X - c) + c + t        x_{-1} = R(theta) R(-omega) (X - o - c) + c + t - v
    """

    def __init__(self, model: GausSim, scene_of_sequence: Sequence[int]) -> None:
        super().__init__()
        self.scene_of_sequence = tuple(scene_of_sequence)
        self._rest = [s.means for s in model.scenes]
        self._diagonal = [h.diagonal for h in model.hierarchies]
        self._moving = [s.simulated[:, None] for s in model.scenes]
        self._is_free = [s.surroundings.free for s in model.scenes]
        self._surroundings = [cast(SceneSurroundings, s) for s in model.surroundings]
        self._carried: dict[int, Float[Tensor, "K 3"]] = {}

    @abstractmethod
    def parameter(self, sequence_id: int) -> nn.Parameter:
        """The parameter of a sequence."""

    @abstractmethod
    def motion(self, sequence_id: int) -> Float[Tensor, "K 3"]:
        """o, the displacement of x_{-1} from the rest state, reversed [scene units]."""

    def start(self, sequence_id: int) -> Float[Tensor, " 12"]:
        """Translation, rotation, velocity and spin of a free body: the last numbers of its parameter."""
        return self.parameter(sequence_id).flatten()[-START:]

    @abstractmethod
    def set_motion(self, sequence_id: int, motion: Float[Tensor, "K 3"]) -> None:
        """Sets o to the nearest motion to a given one [scene units]."""

    @abstractmethod
    def reach(self, change: float) -> float:
        """Displacement of x_{-1} when the parameter changes by ``change`` [diagonals]."""

    def state(self, sequence_id: int) -> SimState:
        """x_0 and x_{-1} of one sequence [scene units]."""
        like, scene = self.parameter(sequence_id), self.scene_of_sequence[sequence_id]
        rest, motion = self._rest[scene].to(like), self.motion(sequence_id)
        if not self._is_free[scene]:
            before = self._carried.get(sequence_id)
            return SimState(rest, (rest if before is None else before.to(like)) - motion)
        translation, rotation, velocity, spin = self.start(sequence_id).view(4, 3)
        turned, back = rotation_of(rotation), rotation_of(-spin)
        moving = self._moving[scene].to(like.device)
        offset = torch.where(moving, rest, 0.0).sum(0) / moving.sum()
        centre = offset + self._diagonal[scene] * translation
        now = (rest - offset) @ turned.mT + centre
        before = (rest - motion - offset) @ (turned @ back).mT + centre - self._diagonal[scene] * velocity
        return SimState(torch.where(moving, now, rest), torch.where(moving, before, rest))

    @torch.no_grad()
    def begin(self, sequence_id: int, translation: Float[Tensor, " 3"], velocity: Float[Tensor, " 3"]) -> None:
        """Lets a free body begin at a translation from rest [scene units] with a velocity [scene units / frame]."""
        diagonal = self._diagonal[self.scene_of_sequence[sequence_id]]
        start = self.start(sequence_id)
        start[:3], start[6:9] = translation / diagonal, velocity / diagonal

    def hold(self, sequence_id: int, path: HandPath) -> None:
        """Lets the body be in hands, which already move at frame 0, and carry it along at frame -1."""
        scene = self.scene_of_sequence[sequence_id]
        shape, rest = self._surroundings[scene].shape, self._rest[scene]
        if shape is None:
            raise ConfigError(f"hands.npz: the scene of sequence {sequence_id} has no kernel in a hand.")
        self._carried[sequence_id] = rest + shape.kernels(path.pose(-1)).to(rest) - shape.kernels(path.pose(0)).to(rest)


class FreeInitialStates(InitialStates):
    """Per-kernel initial states: o is an offset per kernel, K x 3 parameters per sequence, initially zero."""

    def __init__(self, model: GausSim, scene_of_sequence: Sequence[int]) -> None:
        """Creates one parameter per sequence; pinned and never-simulated kernels stay at X."""
        super().__init__(model, scene_of_sequence)
        self._free = [(s.simulated & ~s.pinned)[:, None] for s in model.scenes]
        rows = [len(rest) + (START // 3 if free else 0) for rest, free in zip(self._rest, self._is_free, strict=True)]
        self.offset = nn.ParameterList(torch.zeros(rows[i], 3).to(self._rest[i]) for i in self.scene_of_sequence)

    def parameter(self, sequence_id: int) -> nn.Parameter:
        """The negated offsets in diagonals, and the start of a free body in four more rows."""
        return self.offset[sequence_id]

    def motion(self, sequence_id: int) -> Float[Tensor, "K 3"]:
        """The motion o [scene units]; the parameter is in diagonals of the scene."""
        scene = self.scene_of_sequence[sequence_id]
        offset = self.offset[sequence_id][: len(self._rest[scene])]
        free = self._free[scene].to(offset.device)
        return -torch.where(free, offset * self._diagonal[scene], torch.zeros_like(offset))

    @torch.no_grad()
    def set_motion(self, sequence_id: int, motion: Float[Tensor, "K 3"]) -> None:
        """Takes the motion of every kernel."""
        self.offset[sequence_id][: len(motion)] = -motion / self._diagonal[self.scene_of_sequence[sequence_id]]

    def reach(self, change: float) -> float:
        """Displacement of x_{-1} when every component of its parameter changes by ``change`` [diagonals]."""
        return change


class ModalInitialStates(InitialStates):
    """Modal initial states: o = sum_m v_m phi_m(X), with M amplitudes v_m of the template's lowest modes per sequence.

    The velocity field of an elastic body is smooth; most per-kernel offsets would remain undetermined by 16 frames.
    """

    def __init__(self, model: GausSim, scene_of_sequence: Sequence[int]) -> None:
        """Creates one parameter per sequence, initially zero; v_m is in the template's units."""
        super().__init__(model, scene_of_sequence)
        every = (model.smooth_motions(scene_id) for scene_id in range(len(self._rest)))
        self._basis = [motions.kernels / motions.sizes for motions in every]
        sizes = [b.shape[-1] + (START if free else 0) for b, free in zip(self._basis, self._is_free, strict=True)]
        self.velocity = nn.ParameterList(torch.zeros(sizes[i]) for i in self.scene_of_sequence)

    def basis(self, sequence_id: int) -> Float[Tensor, "K 3 M"]:
        """The motions phi_m of a sequence [scene units]."""
        return self._basis[self.scene_of_sequence[sequence_id]].to(self.velocity[sequence_id])

    def parameter(self, sequence_id: int) -> nn.Parameter:
        """The amplitudes, and the start of a free body in twelve more numbers."""
        return self.velocity[sequence_id]

    def motion(self, sequence_id: int) -> Float[Tensor, "K 3"]:
        """The motion o [scene units]."""
        basis, velocity = self.basis(sequence_id), self.velocity[sequence_id]
        return basis @ velocity[: basis.shape[-1]]

    @torch.no_grad()
    def set_motion(self, sequence_id: int, motion: Float[Tensor, "K 3"]) -> None:
        """Sets the amplitudes by least squares."""
        basis = self._basis[self.scene_of_sequence[sequence_id]].to(motion).double().flatten(0, 1)
        amplitudes = torch.linalg.solve(basis.mT @ basis, basis.mT @ motion.double().flatten()).float()
        self.velocity[sequence_id][: len(amplitudes)] = amplitudes

    def reach(self, change: float) -> float:
        """Displacement of x_{-1} when v_0 changes by ``change``, smallest over the scenes [diagonals]."""
        moved = [float(basis[..., 0].norm(dim=1).max()) for basis in self._basis]
        return change * min(most / diagonal for most, diagonal in zip(moved, self._diagonal, strict=True))
