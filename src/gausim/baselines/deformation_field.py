"""A field of space and time that deforms a scene: the HexPlane stage of DreamGaussian4D (Ren et al., 2023).

The original fits it to videos that a diffusion model has dreamt up; here the calibrated videos take their place and
there is no diffusion prior, which the method's name says. The field knows no dynamics: it is fitted to every sequence
by itself, and beyond the trained frames its motion is repeated from frame 0, as the original loops it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.fitted import Fitted, Recorded
from gausim.core import FittedState
from gausim.nn.planes import Planes
from gausim.ops.quaternion import quaternion_to_matrix


class Field(nn.Module):
    """Offsets of position, logarithmic scales and quaternion at points of space and time; all zero at first.

    Attributes:
        planes: features.
        trunk: one layer that the heads share.
        heads: of position, scales and quaternion.
    """

    def __init__(self, resolution: Sequence[int], features: int, hidden: int) -> None:
        """Draws its parameters from the global generator."""
        super().__init__()
        self.planes = Planes(resolution, features)
        self.trunk = nn.Linear(features, hidden)
        self.heads = nn.ModuleList(_head(hidden, size) for size in (3, 3, 4))

    def forward(self, points: Float[Tensor, "P 4"]) -> tuple[Tensor, Tensor, Tensor]:
        """Offsets (P, 3), (P, 3) and (P, 4) at points in [-1, 1]^4, time last."""
        found = self.trunk(self.planes(points))
        first, second, third = (head(found) for head in self.heads)
        return first, second, third


def _head(hidden: int, size: int) -> nn.Sequential:
    last = nn.Linear(hidden, size)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last)


class DeformationField(Fitted):
    """One field, and one refined rest state, per sequence.

    With q_0, s_0 a kernel's rest quaternion and scales, q = q_0 + dq and s = s_0 exp(dlog s), its covariance is
    R(q) diag(s^2) R(q)^T. As G S G^T that is G = R(q) diag(s / s_0) R(q_0)^T, and colours turn with R(q) R(q_0)^T (the
    original leaves them). Held kernels stay at rest. Lengths inside are in half the longest side of the scene.
    """

    name = "deformation_field (no diffusion prior)"
    extrapolates = False

    def __init__(
        self,
        *,
        resolution: int = 32,
        features: int = 32,
        hidden: int = 64,
        **recorded: Unpack[Recorded],
    ) -> None:
        """Makes the fields.

        Args:
            resolution: of the planes along each axis of space; along time they have a row for every seen frame.
            features: channels of the planes.
            hidden: width of the layers behind them.
        """
        super().__init__(**recorded)
        sizes, counts = [resolution] * 3 + [self.seen + 1], [self.scenes[i].count for i in self.scene_of_sequence]
        self.fields = nn.ModuleList(Field(sizes, features, hidden) for _ in counts)
        self.means = nn.ParameterList(torch.zeros(count, 3) for count in counts)
        self.scales = nn.ParameterList(torch.zeros(count, 3) for count in counts)
        self.rotations = nn.ParameterList(torch.zeros(count, 4) for count in counts)

    def notes(self) -> tuple[str, ...]:
        """What it is and is not."""
        return (
            "DreamGaussian4D's HexPlane stage on the calibrated videos, without its diffusion prior; one fit per "
            f"sequence. Frames after {self.seen} repeat frames 0..{self.seen}, as the original loops its videos.",
        )

    def advance(self, state: FittedState) -> FittedState:
        """The next frame; after the last trained one, frame 0 again."""
        frame = state.frame + 1
        phase = frame % (self.seen + 1)
        if phase == 0:
            rest = self.begin(state.sequence_id)
            return FittedState(state.sequence_id, frame, rest.positions, rest.deformation_gradients, rest.rotations)
        return FittedState(state.sequence_id, frame, *self._deformed(state.sequence_id, phase))

    def _deformed(self, sequence_id: int, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, gradients and rotations of all kernels in a trained frame."""
        scene = self.scenes[self.scene_of_sequence[sequence_id]].to(self._device)
        x = scene.means[scene.simulated]
        half = float((x.amax(0) - x.amin(0)).max()) / 2
        place = (scene.means - (x.amax(0) + x.amin(0)) / 2) / half
        time = place.new_full((len(place), 1), 2 * frame / self.seen - 1)
        found = self.fields[sequence_id](torch.cat((place + self.means[sequence_id], time), 1))
        own = (self.means[sequence_id], self.scales[sequence_id], self.rotations[sequence_id])
        free = (scene.simulated & ~scene.pinned).to(place)[:, None]
        shift, stretch, turn = (free * (a + b) for a, b in zip(found, own, strict=True))
        quats = nn.functional.normalize(scene.quats, dim=-1)
        back = quaternion_to_matrix(quats).mT
        turned = quaternion_to_matrix(quats + turn)
        return scene.means + half * shift, (turned * torch.exp(stretch)[:, None, :]) @ back, turned @ back

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``planes`` and ``layers`` of the fields; ``means``, ``scales``, ``rotations`` of the refined rest states."""
        fields = [field for field in self.fields if isinstance(field, Field)]
        return {
            "planes": [p for field in fields for p in field.planes.parameters()],
            "layers": [p for field in fields for part in (field.trunk, field.heads) for p in part.parameters()],
            "means": list(self.means),
            "scales": list(self.scales),
            "rotations": list(self.rotations),
        }

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """``variation`` of the planes in space and their ``unsteadiness`` in time."""
        field = self.fields[sequence_id]
        assert isinstance(field, Field)
        return {"variation": field.planes.variation(), "unsteadiness": field.planes.unsteadiness()}
