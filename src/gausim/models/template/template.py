"""Template states: the configuration that the predicted deformation gradients deform further.

The recursion of METHOD section 2 deforms a template: x_i = x_p + C_i (T_i - T_p), where C_i accumulates the network's
gradients. In the paper the template is the rest state. An inertial template (:mod:`gausim.models.template.elastic`)
moves on its own between frames; the network then predicts its correction, and zero output
keeps the motion instead of the rest pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.models.hierarchy.batch import SceneBatch, rows_by_scene
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.ops.deformation import bounded_deformation

# Below this a gradient is no longer a deformation (matter turned inside out); it is pulled back to it.
MIN_DETERMINANT = 0.2


@dataclass(frozen=True, eq=False)
class Motion:
    """Unit positions of the finest predicted level [scene units]."""

    rest: Float[Tensor, "N 3"]
    now: Float[Tensor, "N 3"]
    before: Float[Tensor, "N 3"]


@dataclass(frozen=True, eq=False)
class TemplateState:
    """The template of the finest predicted level."""

    positions: Float[Tensor, "N 3"]  # unit positions [scene units]
    deformation_gradients: Float[Tensor, "N 3 3"] | None  # of each unit, or None for the identity


class PreparedTemplate:
    """The template of a batch while parameters do not change; this one is the rest state, whatever the motion."""

    def __call__(self, motion: Motion) -> TemplateState:
        """The template state at t + 1."""
        return TemplateState(motion.rest, None)

    def carried(self, motion: Motion) -> Motion:
        """The part of the motion that goes on: what the network sees of both states."""
        return motion

    def energy(self, motion: Motion) -> Float[Tensor, " S"]:
        """Energy of every member of the batch.

        Raises:
            NotImplementedError: the template has none.
        """
        raise NotImplementedError("the rest state has no energy")


class Template(nn.Module, ABC):
    """Proposes the next configuration of the finest predicted level from its two latest ones.

    Attributes:
        has_energy: whether what :meth:`prepare` makes has an energy, as :class:`PreparedScenes` has.
        headroom: so many times the energy that a rollout begins with is allowed in its first frames.
        is_shared: whether its parameters serve all scenes, as the network's do, or are each a scene's own.
    """

    has_energy, is_shared = False, False
    headroom = 1.0

    @abstractmethod
    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedTemplate:
        """The template of one batch while parameters do not change: it takes the motion to the template state at t + 1.

        Args:
            batch: the disjoint graph.
            units: constants of the finest predicted level, densities and attributes among them.
        """

    def mixing(self, scene_id: int) -> Float[Tensor, ""] | None:
        """How far the template has left the body it began with, differentiable; None where it learns no body."""
        return None

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """What a scene has of its own in the template: names in its state dict, each behind ``prefix``."""
        return ()

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor] | None:
        """Smooth motions of one scene that the template can carry: (N, 3, M), their gradients (N, 3, 3, M), sizes (M,).

        See :class:`gausim.core.SmoothMotions`.
        """
        return None


class ModalScene(ABC):
    """A template in modal coordinates z of one scene, while its parameters do not change; for S sequences at once."""

    def __init__(
        self, projection: Float[Tensor, "N 3 M"], modes: Float[Tensor, "N 3 M"], gradients: Float[Tensor, "N 3 3 M"]
    ) -> None:
        """From what gives z of displacements, and what z gives: displacements and their gradients."""
        self.projection = projection.flatten(0, 1)
        # Positions and gradients of a unit side by side: one product gives both.
        self.motions = torch.cat((modes, gradients.flatten(1, 2)), 1).flatten(0, 1)

    def __call__(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 12"]:
        """Displacement and its gradient, row by row, of every unit at t + 1."""
        return (self.after(*self.coordinates(now, before)) @ self.motions.mT).view(*now.shape[:2], 12)

    def coordinates(
        self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]
    ) -> tuple[Float[Tensor, "S M"], Float[Tensor, "S M"]]:
        """z_t and z_{t-1}."""
        z, previous = (torch.cat((now, before)).flatten(1) @ self.projection).chunk(2)
        return z, previous

    def carried(self, displacement: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 3"]:
        """The part of a displacement that the network sees, of what the template carries from frame to frame: all."""
        return displacement

    @abstractmethod
    def after(self, z: Float[Tensor, "S M"], previous: Float[Tensor, "S M"]) -> Float[Tensor, "S M"]:
        """z_{t+1}."""

    @abstractmethod
    def energy(self, z: Float[Tensor, "S M"], previous: Float[Tensor, "S M"]) -> Float[Tensor, " S"]:
        """Energy, constants but for the state; v the step, m the middle of both, as the trapezoidal rule has it."""


class PreparedScenes(PreparedTemplate):
    """The template of a batch, scene by scene."""

    def __init__(self, batch: SceneBatch, made: Callable[[int, Tensor], ModalScene], *, conserve_volume: bool) -> None:
        """Prepares every scene; ``made`` is called with its number and the rows of one member's units."""
        self._conserve_volume = conserve_volume
        self.parts = [
            (made(scene_id, rows[: len(rows) // len(members)]), rows, members)
            for scene_id, rows, members in rows_by_scene(batch)
        ]
        order = torch.cat([rows for _, rows, _ in self.parts])
        self._places = torch.empty_like(order).index_copy(0, order, torch.arange(len(order), device=order.device))

    def _displacements(self, motion: Motion, rows: Tensor, members: list[int]) -> tuple[Tensor, Tensor]:
        alone = len(self.parts) == 1
        now, before = (
            (x - motion.rest if alone else x.index_select(0, rows) - motion.rest.index_select(0, rows))
            for x in (motion.now, motion.before)
        )
        return now.view(len(members), -1, 3), before.view(len(members), -1, 3)

    def __call__(self, motion: Motion) -> TemplateState:
        """Positions X + u and deformation gradients I + grad u, their determinants bounded."""
        made = [part(*self._displacements(motion, rows, members)).flatten(0, 1) for part, rows, members in self.parts]
        moved = made[0] if len(made) == 1 else torch.cat(made).index_select(0, self._places)
        deformation = moved[:, 3:].reshape(-1, 3, 3) + torch.eye(3, dtype=moved.dtype, device=moved.device)
        deformation = bounded_deformation(deformation, MIN_DETERMINANT, unit=self._conserve_volume)
        return TemplateState(motion.rest + moved[:, :3], deformation)

    def carried(self, motion: Motion) -> Motion:
        """The part of the motion that goes on, scene by scene."""
        made = []
        for part, rows, members in self.parts:
            both = torch.cat(self._displacements(motion, rows, members))
            made.append(torch.stack([x.flatten(0, 1) for x in part.carried(both).chunk(2)]))
        seen = made[0] if len(made) == 1 else torch.cat(made, 1).index_select(1, self._places)
        return Motion(motion.rest, motion.rest + seen[0], motion.rest + seen[1])

    def energy(self, motion: Motion) -> Float[Tensor, " S"]:
        """Energy of every member of the batch."""
        found = [
            p.energy(*p.coordinates(*self._displacements(motion, rows, members))) for p, rows, members in self.parts
        ]
        order = torch.tensor([m for _, _, members in self.parts for m in members], device=motion.rest.device)
        return torch.cat(found).index_select(0, order.argsort())


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

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedTemplate:
        """Rest positions, identity deformation gradients, no energy; the network sees all of the motion."""
        return PreparedTemplate()
