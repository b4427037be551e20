"""Template states: the configuration that the predicted gradients deform.

The recursion of METHOD section 2 deforms a template: x_i = x_p + C_i (T_i - T_p), where C_i accumulates the network's
gradients. In the paper the template is the rest state. An inertial template (:mod:`gausim.models.elastic`) moves on its
own between frames; the network then predicts its correction, and zero output keeps the motion instead of the rest pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from gausim.models.batch import SceneBatch
from gausim.models.hierarchy import Hierarchy
from gausim.models.units import FixedUnits


@dataclass(frozen=True, eq=False)
class Motion:
    """Unit positions of the finest predicted level [scene units]."""

    rest: Float[Tensor, "N 3"]
    now: Float[Tensor, "N 3"]
    before: Float[Tensor, "N 3"]


@dataclass(frozen=True, eq=False)
class TemplateState:
    """The template of the finest predicted level.

    Attributes:
        positions: unit positions [scene units].
        gradients: deformation gradient of each unit, or None for the identity.
    """

    positions: Float[Tensor, "N 3"]
    gradients: Float[Tensor, "N 3 3"] | None


class Template(nn.Module, ABC):
    """Proposes the next configuration of the finest predicted level from its two latest ones.

    Attributes:
        has_energy: whether :meth:`energy` is there.
        headroom: so many times the energy that a rollout begins with is allowed in its first frames.
        is_shared: whether its parameters serve all scenes, as the network's do, or are each a scene's own.
    """

    has_energy, is_shared = False, False
    headroom = 1.0

    @abstractmethod
    def prepare(self, batch: SceneBatch, units: FixedUnits) -> Callable[[Motion], TemplateState]:
        """The template of one batch while parameters do not change: it takes the motion to the template state at t + 1.

        Args:
            batch: the disjoint graph.
            units: constants of the finest predicted level, densities and attributes among them.
        """

    def energy(self, batch: SceneBatch, motion: Motion, prepared: Any) -> Float[Tensor, " S"]:
        """Energy of every member of a batch in the template's own terms, up to a factor; see ``has_energy``.

        Args:
            batch: the disjoint graph.
            motion: of the units.
            prepared: from :meth:`prepare`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def mixing(self, scene_id: int) -> Float[Tensor, ""] | None:
        """How far the template has left the body it began with, differentiable; None where it learns no body."""
        return None

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """What a scene has of its own in the template: names in its state dict, each behind ``prefix``."""
        return ()

    def networks(self) -> list[nn.Parameter]:
        """Weights of neural networks in the template; they learn at the pace of a network."""
        return []

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor] | None:
        """Smooth motions of one scene that the template can carry: (N, 3, M), their gradients (N, 3, 3, M), sizes (M,).

        See :class:`gausim.core.SmoothMotions`.
        """
        return None


class RestTemplate(Template):
    """The paper's template: the rest state, whatever the motion."""

    def __init__(
        self,
        hierarchies: Sequence[Hierarchy],
        finest: int,
        *,
        attributes: int = 0,
        frames: Sequence[np.ndarray] = (),
        conserve_volume: bool = True,
    ) -> None:
        """Takes what every template takes; the rest state needs none of it."""
        super().__init__()

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> Callable[[Motion], TemplateState]:
        """Rest positions, identity gradients."""
        return lambda motion: TemplateState(motion.rest, None)
