"""A net of springs fitted to videos: Spring-Gaus (Zhong et al., ECCV 2024), for objects with pinned parts.

Anchors on a grid are joined by springs; kernels follow their nearest anchors. The fitted parameters are an initial
velocity per anchor and sequence and, per object, a stiffness per anchor, an attenuation of far springs and a damping.
All sequences of an object have the same object parameters; the original has one sequence per object.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import eigsh
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.fitted import Fitted, FittedState, Recorded, moved
from gausim.baselines.spring_gaus.anchors import Anchors
from gausim.baselines.spring_gaus.springs import Net, move
from gausim.core import ConfigError, DivergenceError

# Values of the original.
ANCHORS, NEIGHBOURS, SUBSTEPS, DAMPING = 2048, 256, 100, 0.1
# Limit of the substeps per frame, in multiples of the configured number; stiffer springs are an error.
MOST_SUBSTEPS = 16


class SpringMass(Fitted):
    """Spring-Gaus: anchors of mass 1 joined by springs, without gravity, pinned where the object is.

    A spring between a and b has kappa = att 10^((k_a + k_b) / 2) / L_0 and drag att damping / L_0 (lengths in
    diagonals of the scene, times in seconds); :mod:`gausim.baselines.spring_gaus.springs` has the law and att.
    Velocities are in diagonals per frame and 0 for pinned anchors. Kernels follow, turn and stretch with their anchors;
    in the original they keep their shape.
    """

    name = "spring_mass"
    unknown = frozenset({"free", "gravity", "trained_gravity", "floor", "hands"})

    def __init__(
        self,
        *,
        anchors: int = ANCHORS,
        neighbours: int = NEIGHBOURS,
        substeps: int = SUBSTEPS,
        damping: float = DAMPING,
        stiffness: float | None = None,
        period: float = 12.0,
        **recorded: Unpack[Recorded],
    ) -> None:
        """Places anchors and springs.

        Args:
            anchors: maximum number per scene.
            neighbours: number of nearest anchors to which an anchor has springs.
            substeps: minimum per frame; stiff springs get more.
            damping: force per closing speed of a spring's ends, times its rest length [diagonals / s].
            stiffness: k at the start; None derives it from ``period``.
            period: period of the slowest vibration at the start [frames].

        Raises:
            ConfigError: a number out of range.
            SceneError: too few anchors.
        """
        super().__init__(**recorded)
        if anchors < 4:
            raise ConfigError(f"model.method.anchors: expected at least 4, got {anchors}.")
        if min(neighbours, substeps) < 1 or damping <= 0 or period <= 0:
            raise ConfigError(
                "model.method: expected neighbours, substeps >= 1 and damping, period > 0, got "
                f"{neighbours}, {substeps}, {damping} and {period}."
            )
        self.most, self.neighbours, self.substeps = anchors, neighbours, substeps
        self._anchors = [Anchors.of(scene, anchors) for scene in self.scenes]
        self.velocity = nn.ParameterList(torch.zeros(len(self._anchors[i].rest), 3) for i in self.scene_of_sequence)
        self._nets = [Net.of(a.rest, a.pinned, neighbours) for a in self._anchors]
        self.attenuation = nn.ParameterList(torch.zeros(()) for _ in self.scenes)
        self.damping = nn.ParameterList(torch.tensor(math.log10(damping)) for _ in self.scenes)
        self.stiffness = nn.ParameterList(torch.zeros(len(a.rest)) for a in self._anchors)
        for scene_id, values in enumerate(self.stiffness):
            nn.init.constant_(values, self._matching(scene_id, period) if stiffness is None else stiffness)

    def _matching(self, scene_id: int, period: float) -> float:
        """The k with which the slowest vibration has the given period [frames]."""
        kappa = self.springs(scene_id)[0].detach()
        slowest = slowest_vibration(self._nets[scene_id], self._anchors[scene_id], kappa)
        return math.log10((2 * math.pi / period) ** 2 / slowest)

    def notes(self) -> tuple[str, ...]:
        """Sizes that are smaller than the original's."""
        smaller = [
            f"{here} {name} instead of {full}"
            for here, full, name in ((self.most, ANCHORS, "anchors"), (self.neighbours, NEIGHBOURS, "neighbours"))
            if here < full
        ]
        return (f"Spring-Gaus with at most {', '.join(smaller)}.",) if smaller else ()

    def anchors(self, sequence_id: int) -> Anchors:
        """The anchors of a sequence's scene."""
        scene_id = self.scene_of_sequence[sequence_id]
        if self._anchors[scene_id].rest.device != self._device:
            self._anchors[scene_id] = moved(self._anchors[scene_id], self._device)
        return self._anchors[scene_id]

    def begin(self, sequence_id: int) -> FittedState:
        """The rest state with the fitted velocity."""
        anchors = self.anchors(sequence_id)
        return self.state(sequence_id, 0, anchors.rest, self.velocity[sequence_id] * anchors.free)

    def state(self, sequence_id: int, frame: int, x: Float[Tensor, "A 3"], v: Float[Tensor, "A 3"]) -> FittedState:
        """The state of the kernels for anchors at ``x`` with velocities ``v``."""
        anchors = self.anchors(sequence_id)
        displacement = x - anchors.rest
        turned = anchors.deformation_gradients(displacement)
        return FittedState(sequence_id, frame, anchors.positions(displacement), *turned, (x, v))

    def springs(self, scene_id: int) -> tuple[Float[Tensor, " E"], Float[Tensor, " E"]]:
        """Stiffness kappa [1 / frames^2] and drag [1 / frames] of every spring of a scene."""
        if self._nets[scene_id].length.device != self._device:
            self._nets[scene_id] = moved(self._nets[scene_id], self._device)
        net = self._nets[scene_id]
        k, fps = self.stiffness[scene_id], self.fps[scene_id]
        firm = net.attenuation(self.attenuation[scene_id]) / net.length
        both = 0.5 * (k.index_select(0, net.first) + k.index_select(0, net.second))
        ten = math.log(10)
        return firm * torch.exp(ten * both) / fps**2, firm * torch.exp(ten * self.damping[scene_id]) / fps

    def advance(self, state: FittedState) -> FittedState:
        """One frame of semi-implicit Euler.

        Raises:
            DivergenceError: the springs need more than :data:`MOST_SUBSTEPS` times the configured substeps.
        """
        scene_id = self.scene_of_sequence[state.sequence_id]
        kappa, drag = self.springs(scene_id)
        x, v = state.inner
        free, net = self.anchors(state.sequence_id).free, self._nets[scene_id]
        x, v = move(net, x, v, kappa, drag, free, self._count(scene_id, kappa.detach(), drag.detach()))
        return self.state(state.sequence_id, state.frame + 1, x, v)

    def _count(self, scene_id: int, kappa: Tensor, drag: Tensor) -> int:
        """Substeps per frame: semi-implicit Euler needs omega dt < 2 (the bound here is 1) and drag dt < 1."""
        net = self._nets[scene_id]
        needed = max(math.sqrt(net.stiffest(kappa)), 2 * net.stiffest(drag))
        if not needed <= MOST_SUBSTEPS * self.substeps:
            raise DivergenceError(
                f"{self.name}, '{self.scenes[scene_id].name}': the springs would need {needed:.0f} substeps per frame, "
                f"expected at most {MOST_SUBSTEPS * self.substeps}. Lower the stage's rate of stiffness, or raise "
                "model.method.substeps."
            )
        return max(self.substeps, math.ceil(needed))

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``velocity`` per sequence; ``stiffness``, ``attenuation`` and ``damping`` per object."""
        return {
            "velocity": list(self.velocity),
            "stiffness": list(self.stiffness),
            "attenuation": list(self.attenuation),
            "damping": list(self.damping),
        }


def stiffness_matrix(net: Net, anchors: Anchors, kappa: Float[Tensor, " E"]) -> csc_matrix:
    """Stiffness of the free anchors' coordinates about rest [1 / frames^2], in the order of the anchors."""
    d = ((anchors.rest[net.second] - anchors.rest[net.first]) / net.length[:, None]).double()
    blocks = (kappa.double()[:, None, None] * d[:, :, None] * d[:, None, :]).numpy()
    rows, columns, values = [], [], []
    axes, ends = np.arange(3), (net.first.numpy(), net.second.numpy())
    for a, b in ((0, 0), (1, 1), (0, 1), (1, 0)):
        row, column = 3 * ends[a][:, None, None] + axes[:, None], 3 * ends[b][:, None, None] + axes
        rows.append(np.broadcast_to(row, blocks.shape).ravel())
        columns.append(np.broadcast_to(column, blocks.shape).ravel())
        values.append((blocks if a == b else -blocks).ravel())
    size = 3 * len(anchors.rest)
    whole = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (size, size)).tocsc()
    free = np.repeat(~anchors.pinned.numpy(), 3)
    return whole[free][:, free]


def slowest_vibration(net: Net, anchors: Anchors, kappa: Float[Tensor, " E"]) -> float:
    """Squared angular frequency of the slowest vibration about rest [1 / frames^2], without rigid motions."""
    stiff = stiffness_matrix(net, anchors, kappa)
    largest = float(abs(stiff).sum(0).max())
    count = min(7, stiff.shape[0] - 1)  # six of them may be rigid
    start = np.ones(stiff.shape[0])  # a random vector would make runs differ
    found = np.sort(eigsh(stiff, k=count, sigma=-1e-9 * largest, v0=start, return_eigenvectors=False))
    return float(next((value for value in found if value > 1e-7 * largest), largest))
