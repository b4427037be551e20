"""Surroundings of the scenes: what is trained of them, and the references of a batch's bodies."""

import math
from functools import cached_property
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import GaussianScene
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.models.reference.floor import Contact, Elasticity
from gausim.models.reference.free import FreeBody
from gausim.models.reference.held import HeldBody, StaticShape
from gausim.models.reference.reference import Body, MovingReference, Reference
from gausim.models.template.solid import SolidSettings
from gausim.models.template.template import PreparedTemplate

# Initial coefficients where they are trained.
FRICTION, RESTITUTION = 0.3, 0.1
# Gravity per unit of its parameter [diagonals / frame^2], so that one rate trains it and the material.
GRAVITY_GAIN = 0.1


class SceneSurroundings(nn.Module):
    """Gravity and floor of one scene, and the static shape of a body in hands."""

    def __init__(self, scene: GaussianScene, hierarchy: Hierarchy, finest: int, fps: float) -> None:
        """Creates parameters for what the scene leaves to training."""
        super().__init__()
        self.facts, self.diagonal = scene.surroundings, hierarchy.diagonal
        self.unit = GRAVITY_GAIN * self.diagonal * fps**2
        floor = self.facts.floor
        given = torch.tensor(self.facts.gravity or (0.0, 0.0, 0.0))
        self.gravity = nn.Parameter(given / self.unit) if self.facts.trains_gravity else None
        self.friction = self.restitution = None
        if floor is not None and floor.friction is None:
            self.friction = nn.Parameter(torch.tensor(math.log(math.expm1(FRICTION))))
        if floor is not None and floor.restitution is None:
            self.restitution = nn.Parameter(torch.logit(torch.tensor(RESTITUTION)))
        self.solid = SolidSettings()  # of the static shape
        self.moves = not self.facts.still or scene.hand is not None
        self._built_from = scene, hierarchy, finest

    @cached_property
    def shape(self) -> StaticShape | None:
        """The static shape of a body in hands or pins; None for a free body."""
        return None if self.facts.free else StaticShape(*self._built_from, self.solid)

    def acceleration(self, dt: float, like: Tensor) -> Float[Tensor, " 3"]:
        """Gravity [scene units / frame^2]."""
        if self.gravity is not None:
            return self.gravity.to(like) * (self.unit * dt**2)
        return like.new_tensor(self.facts.gravity or (0.0, 0.0, 0.0)) * dt**2

    def contact(self, like: Tensor) -> Contact | None:
        """The floor with its coefficients."""
        floor = self.facts.floor
        if floor is None:
            return None
        friction = like.new_tensor(floor.friction) if self.friction is None else nn.functional.softplus(self.friction)
        bounce = like.new_tensor(floor.restitution) if self.restitution is None else torch.sigmoid(self.restitution)
        return Contact(floor, friction, bounce, self.diagonal)


def reference_of(
    surroundings: nn.ModuleList,
    batch: SceneBatch,
    mass: Float[Tensor, " M"],
    units: FixedUnits,
    template: PreparedTemplate,
    axes: Float[Tensor, "N 3 3"],
    *,
    driven: bool = False,
) -> Reference:
    """The reference of a batch.

    Args:
        surroundings: :class:`SceneSurroundings` of every scene.
        batch: the sequences.
        mass: masses of the simulated kernels.
        units: constants of the finest predicted level, in scene axes.
        template: of the batch, which yields to contacts.
        axes: axes of the template's modes, as rows, per unit.
        driven: let the pins of every scene move; those without recorded hands are one hand.
    """
    scenes = [cast(SceneSurroundings, surroundings[i]) for i in batch.scene_ids]
    if not driven and not any(own.moves for own in scenes):
        return Reference(batch, units.rest)
    masses = batch.rest.new_zeros(len(batch.rest)).index_copy(0, batch.simulated, mass)
    bodies: list[Body] = []
    for number, (member, span, own) in enumerate(zip(batch.members, batch.levels[-1].spans, scenes, strict=True)):
        if not (driven or own.moves):
            bodies.append(Body(units.rest[span]))
            continue
        rest, kernels = units.rest[span], batch.rest[member.kernels]
        contact, gravity = own.contact(rest), own.acceleration(float(batch.levels[-1].dt[span.start]), rest)
        modes, slopes, matrices, whole = template.compliance(number)
        turn = axes[span]  # to scene axes
        modes, slopes = turn.mT @ modes, torch.einsum("nca,ncdm,ndb->nabm", turn, slopes, turn)
        unit = member.unit_of_kernel
        offset = kernels - torch.cat((rest, rest.new_zeros(1, 3)))[unit]
        fraction = masses[member.kernels] / masses[member.kernels].sum()
        elasticity = Elasticity(unit, offset, modes, slopes, matrices, whole, fraction, own.facts.free)
        if own.shape is None:
            bodies.append(FreeBody(kernels, rest, masses[member.kernels], gravity, contact, elasticity))
        else:
            bodies.append(HeldBody(own.shape, kernels, rest, gravity, contact, elasticity))
    return MovingReference(batch, units.rest, bodies)
