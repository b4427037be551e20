"""Linear AR(2) on motion tracked in the images: what images alone give a linear model.

Each seen frame is a displacement of Spring-Gaus' anchors in the slowest modes of their springs, fitted to its images;
modes have equal elastic energy, so that what no camera sees stays at rest. A linear AR(2) is fitted to these
displacements by least squares, and predicts from the tracked frames 0 and 1, like the reference row on true states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.linalg import eigsh
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.fitted import Recorded
from gausim.baselines.linear_ar import LinearAR2, fit_linear_ar2
from gausim.baselines.spring_gaus.anchors import Anchors
from gausim.baselines.spring_gaus.spring_mass import AnchoredMotion, stiffness_matrix
from gausim.baselines.spring_gaus.springs import Net
from gausim.core import ConfigError, FittedState

# Typical displacement of the first mode at a coordinate of 1 [diagonals].
UNIT = 0.01


class LinearTracks(AnchoredMotion):
    """Tracks while it is trained, and predicts by the linear model in evaluation mode."""

    name = "linear AR(2) on tracked motion"

    def __init__(
        self, *, anchors: int, neighbours: int = 64, basis: int = 48, modes: int = 8, **recorded: Unpack[Recorded]
    ) -> None:
        """Places at most ``anchors`` per scene and finds their slowest modes.

        Args:
            anchors: maximum number per scene.
            neighbours: number of nearest anchors to which an anchor has springs.
            basis: number of modes in which frames are tracked.
            modes: number of principal motions of the linear model.
        """
        super().__init__(anchors=anchors, **recorded)
        if min(neighbours, basis, modes) < 1 or self.seen < 2:
            raise ConfigError(
                "model.method: expected neighbours, basis, modes >= 1 and plan.t_max >= 2, got "
                f"{neighbours}, {basis}, {modes} and {self.seen}."
            )
        self.modes, self.velocity = modes, nn.ParameterList()
        for scene_id, own in enumerate(self._anchors):
            self.register_buffer(f"basis_{scene_id}", smooth_basis(own, neighbours, basis))
        counts = [self.get_buffer(f"basis_{i}").shape[0] for i in self.scene_of_sequence]
        self.changes = nn.ParameterList(torch.zeros(self.seen, n) for n in counts)  # a frame begins where the last is

    def tracked(self, sequence_id: int) -> Float[Tensor, "F A 3"]:
        """Displacement of the anchors in the seen frames, frame 0 (rest) first [diagonals]."""
        basis = self.get_buffer(f"basis_{self.scene_of_sequence[sequence_id]}")
        coordinates = torch.cat((self.changes[sequence_id][:1] * 0, self.changes[sequence_id].cumsum(0)))
        return torch.einsum("fm,mai->fai", coordinates, basis)

    def linear(self, scene_id: int) -> LinearAR2:
        """The linear model of an object, fitted to all its sequences."""
        own = [i for i, scene in enumerate(self.scene_of_sequence) if scene == scene_id]
        found = fit_linear_ar2([self.tracked(i).detach() for i in own], self.modes)
        like = self.get_buffer(f"basis_{scene_id}")
        return LinearAR2(*(x.to(like) for x in (found.modes, found.first, found.second)))

    def begin(self, sequence_id: int) -> FittedState:
        """The rest state, and the rest of the sequence: tracked in training, else by the linear model up to frame 1."""
        motion = self.tracked(sequence_id)
        state = self.state(sequence_id, 0, self.anchors(sequence_id).rest, torch.zeros_like(motion[0]))
        if self.training:
            return replace(state, inner=(motion,))
        linear = self.linear(self.scene_of_sequence[sequence_id])
        return replace(state, inner=(motion[:2], linear.modes, linear.first, linear.second))

    def advance(self, state: FittedState) -> FittedState:
        """The next frame."""
        rest, frame = self.anchors(state.sequence_id).rest, state.frame + 1
        inner: tuple[Tensor, ...] = state.inner
        if len(inner) == 1:
            made = inner[0][frame]
        else:
            latest, *linear = inner
            made = latest[1] if frame == 1 else LinearAR2(*linear).rollout(latest, 2)[2]
            inner = (latest if frame == 1 else torch.stack((latest[1], made)), *linear)
        return replace(self.state(state.sequence_id, frame, rest + made, torch.zeros_like(made)), inner=inner)

    def notes(self) -> tuple[str, ...]:
        """How the motion is found, and how it goes on."""
        fit = f"A linear AR(2) in {self.modes} principal motions, fitted by least squares to the motion tracked in the "
        return (fit + "images of the seen frames; it starts from the tracked frames 0 and 1.",)

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``changes`` of the tracked coordinates from frame to frame, one matrix per sequence."""
        return {"changes": list(self.changes)}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """``energy``: mean over the seen frames of the squared coordinates."""
        return {"energy": self.changes[sequence_id].cumsum(0).square().sum(1).mean()}


def smooth_basis(anchors: Anchors, neighbours: int, count: int) -> Float[Tensor, "M A 3"]:
    """The slowest vibrations of equal springs between anchors, scaled to equal elastic energy [diagonals]."""
    net = Net.of(anchors.rest, anchors.pinned, neighbours)
    stiff = stiffness_matrix(net, anchors, 1 / net.length.double())
    count, size = min(count, stiff.shape[0] - 1), float(abs(stiff).sum(0).max())
    values, vectors = eigsh(stiff, k=count, sigma=-1e-9 * size, v0=np.ones(stiff.shape[0]))
    order = np.argsort(values)
    stiffness = np.maximum(values[order], 1e-3 * max(values.max(), 1e-12))  # without pins, rigid motions have none
    scaled = vectors[:, order] * np.sqrt(stiffness[0] / stiffness) * UNIT * np.sqrt(stiff.shape[0] / 3)
    basis = torch.zeros(count, len(anchors.rest), 3)
    basis[:, ~anchors.pinned] = torch.from_numpy(scaled.T.copy()).float().unflatten(1, (-1, 3))
    return basis
