"""The two contracts between rooms: what a method of dynamics offers and what a renderer offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gausim.core.state import SimState, Trajectory

# Forces at a step: step number (0 = the step from frame 0 to 1) -> force per kernel [mass * scene units / s^2],
# or None where nothing pushes.
Forces = Callable[[int], Tensor | None]


@runtime_checkable
class Dynamics(Protocol):
    """A method that predicts the motion of one scene. GausSim and every baseline are this."""

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames after ``initial``; the result has steps + 1 frames, the initial one first."""
        ...


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images of B states seen by V cameras each.

    Attributes:
        rgb: colour composited over the background, linear in the input colours, not clamped.
        alpha: accumulated opacity in [0, 1].
        depth: accumulated depth sum_i w_i z_i [scene units], where kernel i contributes w_i = alpha_i T_i to the pixel
            and has depth z_i at its centre along the camera's axis (gsplat's mode "D"): not divided by ``alpha``, 0
            where nothing is, without the background. None unless it was asked for.
    """

    rgb: Float[Tensor, "B V H W 3"]
    alpha: Float[Tensor, "B V H W"]
    depth: Float[Tensor, "B V H W"] | None = None


@runtime_checkable
class Renderer(Protocol):
    """Draws Gaussians. Differentiable in means, covars, colors, opacities and background."""

    def __call__(
        self,
        means: Float[Tensor, "B K 3"],
        covars: Float[Tensor, "B K 3 3"],
        colors: Float[Tensor, "B V K 3"],
        opacities: Float[Tensor, "B K"],
        viewmats: Float[Tensor, "B V 4 4"],
        Ks: Float[Tensor, "B V 3 3"],
        size: tuple[int, int],
        *,
        background: Float[Tensor, " 3"] | None = None,
        depth: bool = False,
    ) -> Rendered:
        """Draws B states (of one scene, or of scenes of equal K) in V views each at ``size`` = (width, height).

        Colours are per view because they are already evaluated for its directions. No background means black.
        ``depth`` asks for the depth as well.
        """
        ...
