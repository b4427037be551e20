"""Templates: the configuration that the predicted deformation gradients deform.

The recursion of METHOD section 2 deforms a template: x_i = x_p + C_i (T_i - T_p), where C_i accumulates the network's
deformation gradients. In the paper the template is the rest state. A dynamic template
(:mod:`gausim.models.template.material`) predicts the next frame by itself; the network then predicts a correction, and
zero output continues the motion instead of returning to rest.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits, UnitMotion
from gausim.models.template.body_modes import unit_modes
from gausim.models.template.modal import ModalScene
from gausim.models.template.solid import SolidSettings
from gausim.ops.deformation import bounded_deformation

# Deformation gradients with a smaller determinant (nearly or fully inverted matter) are replaced by the identity.
MIN_DETERMINANT = 0.2
ROWS = 1024  # of a matrix of distances that are in memory at once
DENSITY = "density over that at the beginning of training"
# The modes of an even solid: their number, and the spacing of its grid [diagonals].
EVEN_MODES, EVEN_SPACING = 48, 0.12


@dataclass(frozen=True, eq=False)
class Property:
    """A learned material property."""

    values: Float[Tensor, " N"]  # positive; of units, or of kernels, NaN where it is not known
    text: str  # what it is, with its unit


def local_means(
    values: Float[Tensor, " N"], points: Float[Tensor, "N 3"], known: Bool[Tensor, " N"], width: float
) -> Float[Tensor, " N"]:
    """Geometric means of known positive values around every point, weighted by a Gaussian of this deviation."""
    logs, among, exact = values[known].log(), points[known], "donot_use_mm_for_euclid_dist"  # far from the origin, too
    chunks = (torch.cdist(rows, among, compute_mode=exact) / width for rows in points.split(ROWS))
    return torch.cat([(-distance.square() / 2).softmax(-1) @ logs for distance in chunks]).exp()


class PreparedTemplate:
    """The template of a batch between two updates of the parameters; in this base class the rest state."""

    def __init__(self, batch: SceneBatch) -> None:
        self.spans, self.device = batch.levels[-1].spans, batch.rest.device

    def __call__(self, motion: UnitMotion) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3 3"] | None]:
        """Positions T of the units at t + 1, and their deformation gradients P; None for the identity."""
        return motion.rest, None

    def compliance(self, member: int) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
        """How a member of the batch yields to impulses.

        Returns:
            Modes (N, 3, M) and their gradients (N, 3, 3, M); inertia, stiffness and damping (M, M) [frame units];
            and the mass of the body in the modes' units; here the body is rigid, M = 0.
        """
        count = self.spans[member].stop - self.spans[member].start
        none = torch.zeros(0, 0, device=self.device)
        return none.new_zeros(count, 3, 0), none.new_zeros(count, 3, 3, 0), (none, none, none), none.new_ones(())

    def carried(self, motion: UnitMotion) -> UnitMotion:
        """The part of the motion that is input to template and network; here all of it."""
        return motion

    def overshoot(self, displacement: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The part of a displacement by an impulse that its frame does not reach (:meth:`ModalScene.overshoot`)."""
        raise NotImplementedError("the rest state has no energy")

    def energy(self, motion: UnitMotion) -> Float[Tensor, " S"]:
        """Energy of every member of the batch, of templates with :attr:`Template.has_energy`."""
        raise NotImplementedError("the rest state has no energy")

    def dissipated(self, motion: UnitMotion, previous: Float[Tensor, "N 3"]) -> Float[Tensor, " S"]:
        """Energy that damping takes from every member in a step from ``previous`` (t - 1) to the end of ``motion``."""
        raise NotImplementedError("the rest state has no energy")

    def correction_unit(self) -> Float[Tensor, " S"] | None:
        """Factor on the network's output of every member of the batch; None for a factor of 1."""
        return None


class Template(nn.Module, ABC):
    """Interface of templates: the next configuration of the finest predicted level from the last two.

    Attributes:
        has_energy: whether the result of :meth:`prepare` has an energy, as that of :class:`PreparedScenes`.
        headroom: factor on the initial energy of a rollout, the energy guard's limit in its first frames.
        solid: the body whose static shape is the reference of a body in hands.
    """

    has_energy = False
    headroom, solid = 1.0, SolidSettings()

    @abstractmethod
    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedTemplate:
        """The template of one batch between two updates of the parameters, a map from motion to the state at t + 1.

        Args:
            batch: the disjoint graph.
            units: constants of the finest predicted level, densities and attributes among them.
        """

    def material(self, scene_id: int, units: FixedUnits, fps: float) -> dict[str, Property]:
        """Learned properties of the scene's units by name: ``density``, and ``stiffness`` and ``damping`` if known."""
        return {"density": Property(units.log_density.exp(), DENSITY)}

    def shared(self, prefix: str) -> tuple[str, ...]:
        """Prefixes of the names of the parameters that all scenes have in common, each after ``prefix``."""
        return ()

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """Prefixes of the names of a scene's parameters and buffers in the state dict, each after ``prefix``."""
        return ()

    def oscillator(self, scene_id: int) -> Tensor:
        """Mean angular frequency [1 / frame] of a scene's tracked motion, and the part of its energy lost in a frame.

        Of shape (2,), for templates without energy; zeros: unknown.
        """
        return torch.zeros(2)

    @abstractmethod
    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor]:
        """Modes (N, 3, M) of one scene, displacement gradients (N, 3, 3, M), sizes (M,).

        See :class:`gausim.core.SmoothMotions`. Motion is tracked in them.
        """


class PreparedScenes(PreparedTemplate):
    """The template of a batch, scene by scene."""

    def __init__(
        self, batch: SceneBatch, prepare: Callable[[int, Tensor], ModalScene], *, conserve_volume: bool
    ) -> None:
        """Prepares every scene; ``prepare`` is called with its index and the rows of one member's units."""
        super().__init__(batch)
        self._conserve_volume = conserve_volume
        self.parts = [
            (prepare(scene_id, rows[: len(rows) // len(members)]), rows, members)
            for scene_id, rows, members in batch.rows_by_scene
        ]
        order = torch.cat([rows for _, rows, _ in self.parts])
        self._places = torch.empty_like(order).index_copy(0, order, torch.arange(len(order), device=order.device))

    def _displacements(self, motion: UnitMotion, rows: Tensor, members: list[int]) -> tuple[Tensor, Tensor]:
        rest = motion.rest
        now, before = (
            self._members_of(x, rows, members) - self._members_of(rest, rows, members)
            for x in (motion.now, motion.before)
        )
        return now, before

    def _members_of(self, values: Tensor, rows: Tensor, members: list[int]) -> Tensor:
        """Values (S, N, C) of one scene's members from those of all units (N, C)."""
        own = values if len(self.parts) == 1 else values.index_select(0, rows)
        return own.view(len(members), -1, values.shape[1])

    def __call__(self, motion: UnitMotion) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3 3"] | None]:
        """Positions X + u and deformation gradients I + grad u, their determinants bounded."""
        values = []
        for part, rows, members in self.parts:
            load = None if motion.load is None else self._members_of(motion.load, rows, members)
            values.append(part(*self._displacements(motion, rows, members), load).flatten(0, 1))
        moved = self._in_order(values)
        deformation = moved[:, 3:].reshape(-1, 3, 3) + torch.eye(3, dtype=moved.dtype, device=moved.device)
        deformation = bounded_deformation(deformation, MIN_DETERMINANT, unit=self._conserve_volume)
        return motion.rest + moved[:, :3], deformation

    def compliance(self, member: int) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
        """How a member yields to impulses: by the modes of its scene."""
        part = next(part for part, _, members in self.parts if member in members)
        modes, slopes = part.motions.unflatten(0, (-1, 12)).split((3, 9), 1)
        mass = part.mass.diagonal().mean() * (modes.detach().square().sum((1, 2)) > 0).sum()
        return modes, slopes.unflatten(1, (3, 3)), (part.inertia, part.stiffness, part.damping), mass

    def carried(self, motion: UnitMotion) -> UnitMotion:
        """The part of the motion that is input to template and network, scene by scene."""
        values = []
        for part, rows, members in self.parts:
            both = torch.cat(self._displacements(motion, rows, members))
            values.append(torch.stack([x.flatten(0, 1) for x in part.carried(both).chunk(2)]))
        seen = values[0] if len(values) == 1 else torch.cat(values, 1).index_select(1, self._places)
        return replace(motion, now=motion.rest + seen[0], before=motion.rest + seen[1])

    def overshoot(self, displacement: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The part of a displacement by an impulse that its frame does not reach, scene by scene."""
        parts = [part.overshoot(self._members_of(displacement, rows, members)) for part, rows, members in self.parts]
        return self._in_order([values.flatten(0, 1) for values in parts])

    def _in_order(self, values: list[Tensor]) -> Tensor:
        """Values of the units, scene by scene, in the order of the batch."""
        return values[0] if len(values) == 1 else torch.cat(values).index_select(0, self._places)

    def energy(self, motion: UnitMotion) -> Float[Tensor, " S"]:
        """Energy of every member of the batch."""
        return self._by_member([part.energy(*z) for part, z in self._coordinates(motion)])

    def dissipated(self, motion: UnitMotion, previous: Float[Tensor, "N 3"]) -> Float[Tensor, " S"]:
        """Energy that the damping takes from every member in a step from ``previous`` to the end of ``motion``."""
        earlier = self._coordinates(replace(motion, before=previous))
        values = zip(self._coordinates(motion), earlier, strict=True)
        return self._by_member([part.dissipated(*z, before) for (part, z), (_, (_, before)) in values])

    def _coordinates(self, motion: UnitMotion) -> list[tuple[ModalScene, tuple[Tensor, Tensor]]]:
        return [
            (part, part.coordinates(*self._displacements(motion, rows, members))) for part, rows, members in self.parts
        ]

    def correction_unit(self) -> Float[Tensor, " S"] | None:
        """Factor on the network's output of every member of the batch; None for a factor of 1."""
        values = []
        for part, _, members in self.parts:
            unit = part.correction_unit()
            if unit is None:
                return None
            values.append(unit.expand(len(members)))
        return self._by_member(values)

    def _by_member(self, values: list[Tensor]) -> Tensor:
        joined = torch.cat(values)
        if len(self.parts) == 1:
            return joined
        order = [m for _, _, members in self.parts for m in members]
        return torch.stack([joined[order.index(m)] for m in range(len(order))])  # no index that the host would send


class RestTemplate(Template):
    """The paper's template: the rest state. Its modes are those of an even solid, for tracking alone."""

    def __init__(
        self,
        hierarchies: Sequence[Hierarchy],
        finest: int,
        *,
        attributes: int = 0,
        frames: Sequence[np.ndarray] = (),
        conserve_volume: bool = True,
    ) -> None:
        """Takes the arguments of every template; ``frames`` are scene axes when empty."""
        super().__init__()
        self._hierarchies, self._finest = hierarchies, finest
        self._frames = frames or [np.eye(3)] * len(hierarchies)
        self._bases: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
        self.oscillators = nn.Module()  # of every scene, set by the teaching
        for scene_id in range(len(hierarchies)):
            self.oscillators.register_buffer(str(scene_id), torch.zeros(2))

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedTemplate:
        """Rest positions, identity deformation gradients, no energy; all of the motion is input to the network."""
        return PreparedTemplate(batch)

    def oscillator(self, scene_id: int) -> Tensor:
        """Of what :func:`gausim.training.teach.teach` was given."""
        return self.oscillators.get_buffer(str(scene_id))

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """The oscillator."""
        return (f"{prefix}oscillators.{scene_id}",)

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor]:
        """The lowest modes of an even solid of the body's shape, of equal energy; computed when first asked for."""
        if scene_id not in self._bases:
            self._bases[scene_id] = even_modes(self._hierarchies[scene_id], self._finest, self._frames[scene_id])
        return self._bases[scene_id]


def even_modes(hierarchy: Hierarchy, finest: int, frame: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Modes (N, 3, M), displacement gradients and sizes of an even solid, of equal energy (see :meth:`Template.basis`).

    Coordinate 1 of the first mode is a typical displacement, a twentieth of the diagonal. ``frame`` are the axes, as
    rows.
    """
    found = unit_modes(hierarchy, finest, frame, modes=EVEN_MODES, solid=SolidSettings(spacing=EVEN_SPACING))
    sizes = found.values**-0.5
    scale = found.scale * sizes
    made = (found.modes * scale, found.gradients * scale, sizes)
    modes, gradients, sizes_of_modes = (torch.from_numpy(np.ascontiguousarray(x)).float() for x in made)
    return modes, gradients, sizes_of_modes
