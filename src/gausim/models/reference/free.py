"""A free body: its reference is the rest shape in the rigid motion that keeps momentum and angular momentum.

With masses m_k, centres of mass c and r = x - c, a step without a floor has exactly

    c_{t+1} = 2 c_t - c_{t-1} + g            sum_k m_k r_t x r_{t+1} = sum_k m_k r_{t-1} x r_t       [frame units]

which are the discrete momenta of Stoermer's and Verlet's method. The simulator gives the shape w of t + 1, and the
rotation R of r_{t+1} = R w follows from the second equation by Newton's method.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Frame, SimState
from gausim.models.hierarchy.units import UnitMotion
from gausim.models.reference.floor import Contact, Elasticity
from gausim.models.reference.reference import Body, Carried, HandMotion, turned_units
from gausim.ops.deformation import polar_rotation
from gausim.ops.rotation import axial, rotation_of

NEWTON_STEPS = 4


class FreeBody(Body):
    """A member that nothing holds."""

    def __init__(
        self,
        kernels: Float[Tensor, "K 3"],
        rest: Float[Tensor, "N 3"],
        mass: Float[Tensor, " K"],
        gravity: Float[Tensor, " 3"],
        contact: Contact | None,
        elasticity: Elasticity,
    ) -> None:
        """Stores the constants.

        Args:
            kernels: rest positions of all kernels [scene units].
            rest: those of the finest units.
            mass: masses of the kernels; 0 for those never simulated.
            gravity: [scene units / frame^2].
            contact: the floor; None: there is none.
            elasticity: how the body yields to a contact.
        """
        self.mass, self.gravity, self.contact, self.elasticity = mass / mass.sum(), gravity, contact, elasticity
        # Far from the origin a step is small against the positions: their means are taken in double precision.
        self.fractions = mass.double() / mass.double().sum()
        self.centre = self.mass @ kernels
        super().__init__(rest)
        self.kernels = kernels
        self.simulated = mass > 0
        offset = kernels - self.centre
        spread = offset.mT @ (self.mass[:, None] * offset)
        size = torch.linalg.matrix_norm(spread, 2)
        # Of a body in a plane the third axis follows from the others.
        self.inverse = torch.linalg.inv(spread + 1e-6 * size * torch.eye(3).to(spread))
        self.weighted = self.mass[:, None] * offset

    def pose(self, positions: Float[Tensor, "K 3"]) -> tuple[Tensor, Tensor]:
        """Centre of mass c, in double precision, and rotation R of the best fit of the rest shape."""
        centre = self.fractions @ positions.double()
        affine = about(positions, centre).mT @ self.weighted @ self.inverse
        return centre, polar_rotation(affine)

    def turned(self, state: SimState) -> Float[Tensor, "3 3"]:
        """Rotation of the best fit of the rest shape."""
        return self.pose(state.positions)[1]

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: HandMotion | None) -> "FreeMotion":
        """The units in the axes of the body, at both times, and the centrifugal load of its rotation."""
        return FreeMotion(self, now, before, state)


class FreeMotion(Carried):
    """One step of a free body."""

    def __init__(self, body: FreeBody, now: Tensor, before: Tensor, state: SimState) -> None:
        self.body, self.state = body, state
        (self.centre, self.turned), (self.last_centre, last) = body.pose(state.positions), body.pose(state.previous)
        self.guess = self.turned @ last.mT @ self.turned  # at a constant rate of rotation
        acceleration = self.guess - 2 * self.turned + last
        offset = body.units - body.centre
        load = torch.cat((-(offset @ acceleration.mT) @ self.turned, offset.new_zeros(len(offset), 9)), 1)
        present = body.centre + about(now, self.centre) @ self.turned
        past = body.centre + about(before, self.last_centre) @ last
        floor = None if body.contact is None else body.contact.nearness(now, self.turned)
        super().__init__(UnitMotion(body.units, present, past, load, floor))

    def place(self, frame: Frame) -> Frame:
        """The predicted shape, placed so that momentum and angular momentum are kept; then the floor."""
        body = self.body
        shape = frame.positions - body.mass @ frame.positions
        rotation = self._rotation(shape)
        centre = 2 * self.centre - self.last_centre + body.gravity.double()
        moved = (centre + (shape @ rotation.mT).double()).to(shape)
        positions = torch.where(body.simulated[:, None], moved, frame.positions)
        frame = Frame(
            positions, turned_units(rotation, frame.deformation_gradients), turned_units(rotation, frame.rotations)
        )
        if body.contact is None:
            return frame
        return body.contact.resolve(frame, self.state, body.elasticity, rotation, centre.to(shape))

    def _rotation(self, shape: Float[Tensor, "K 3"]) -> Float[Tensor, "3 3"]:
        """R with sum m r_t x R w = sum m r_{t-1} x r_t, in double precision."""
        mass = self.body.mass[:, None].double()
        now, before = self.state.positions.double() - self.centre, self.state.previous.double() - self.last_centre
        target = axial((mass * now).mT @ before)
        carried = (mass * shape.double()).mT @ now
        rotation, identity = self.guess.double(), torch.eye(3, dtype=torch.float64, device=shape.device)
        for _ in range(NEWTON_STEPS):
            turned = rotation @ carried
            change = torch.linalg.solve(turned.trace() * identity - turned, target - axial(turned))
            rotation = rotation_of(change) @ rotation
        return rotation.to(shape)


def about(positions: Float[Tensor, "N 3"], centre: Float[Tensor, " 3"]) -> Float[Tensor, "N 3"]:
    """Positions relative to a centre that is given in double precision."""
    return (positions.double() - centre).to(positions)
