"""Arrows for forces, in the scene and drawn into pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.interaction.interaction import Interaction

_COLOR, _OUTLINE = (255, 170, 40), (20, 20, 20)
# Length of an arrow [diagonals]: for the smallest and for the largest allowed force.
_SHORT, _LONG = 0.08, 0.35


@dataclass(frozen=True, eq=False)
class Arrow:
    """An arrow from the centre of a force's kernels along the force [scene units], labelled with its size."""

    start: Float[Tensor, " 3"]
    end: Float[Tensor, " 3"]
    label: str


def arrows_of(live: Interaction) -> list[Arrow]:
    """Arrows of the forces on the next step, of length increasing with the force."""
    found = []
    for amount, acceleration, name in live.pushes():
        vector = torch.tensor(acceleration)
        size = float(vector.norm()) / live.gravity
        if size == 0:
            continue
        start = live.frame.positions[amount > 0].mean(0).cpu()
        length = (_SHORT + (_LONG - _SHORT) * min(1.0, size / live.most_force)) * live.scene.diagonal
        found.append(Arrow(start, start + vector / vector.norm() * length, f"{name} {size:.2g} weights"))
    return found


def draw_arrows(
    image: np.ndarray, arrows: Sequence[Arrow], viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"]
) -> np.ndarray:
    """A copy of a camera's picture (H, W, 3, uint8) with arrows drawn over it, except those behind the camera."""
    drawn = np.ascontiguousarray(image).copy()
    for arrow in arrows:
        ends = torch.stack((arrow.start, arrow.end)).double() @ viewmat[:3, :3].double().T + viewmat[:3, 3].double()
        if float(ends[:, 2].min()) <= 1e-6:
            continue
        pixels = (ends / ends[:, 2:]) @ K.double().T
        # OpenCV takes 32-bit coordinates; the bound lies far outside the picture.
        a, b = ([int(v) for v in p[:2].clamp(-1e4, 1e4)] for p in pixels)
        for color, width in ((_OUTLINE, 5), (_COLOR, 2)):
            drawn = cv2.arrowedLine(drawn, a, b, color, width, cv2.LINE_AA, tipLength=0.3)
    return drawn
