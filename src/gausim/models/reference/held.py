"""A body in hands, or in pins above a floor: its reference is the static shape that its pins prescribe.

The pins' best rigid motion B carries the whole body. Relative to it every hand is displaced by d_g and turned by
theta_g, and a homogeneous elastic body follows by the static modes Psi of component mode synthesis (Craig and Bampton
1968, :func:`gausim.models.template.solid.static_responses`):

    a(X) = c + B (X - o + sum_g Psi_g(X) (d_g, theta_g)),    A = grad a.

All that the body does besides is relative to a and in the axes B, common to all units. What is nonlinear, finite strain
or the lengths of springs between units (:mod:`gausim.models.template`), knows no rotation and starts from B^T A.
"""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import Frame, GaussianScene, HandPose, SimState
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import UnitMotion
from gausim.models.reference.floor import Contact, Elasticity
from gausim.models.reference.reference import Body, Carried, HandMotion
from gausim.models.template.solid import SolidSettings, static_responses
from gausim.ops.deformation import apply, polar_rotation
from gausim.ops.rotation import rotation_vector

# Poses whose static shape is kept: those of recorded sequences are asked for again and again.
MOST_POSES = 4096


class StaticShape:
    """The reference of the units of one scene, as a function of where its hands are; computed once per scene."""

    def __init__(self, scene: GaussianScene, hierarchy: Hierarchy, finest: int, solid: SolidSettings) -> None:
        """Computes the static modes of a solid body."""
        own, level = scene.means[hierarchy.kernels], hierarchy.levels[finest]
        pinned = scene.pinned[hierarchy.kernels]
        hand = torch.full_like(hierarchy.kernels, -1) if scene.hand is None else scene.hand[hierarchy.kernels]
        self.hands = int(hand.max()) + 1
        held = torch.where(pinned & (hand < 0), self.hands, hand)  # what nobody moves is a hand that stands still
        self.rest, self._scene_rest = level.rest, scene.means
        unit = hierarchy.ancestor(0, finest)
        self.of_kernel = torch.full((scene.count,), -1).index_copy(0, hierarchy.kernels, unit)
        self.of = torch.full((scene.count,), -1).index_copy(0, hierarchy.kernels, torch.where(pinned, held, -1))
        self._pins = own[pinned].double()
        self._holder: Int[Tensor, " P"] = held[pinned]
        if int(self._holder.max()) == 0:  # one hand: the body follows rigidly
            self._centres, self._modes, self._slopes = self._pins.mean(0)[None], None, None
        else:
            kernels = own.double().numpy()
            arrays = static_responses(
                kernels, held.where(pinned, torch.tensor(-1)).numpy(), level.rest.double().numpy(),
                spacing=solid.size(kernels, hierarchy.diagonal),
            )  # fmt: skip
            self._centres, self._modes, self._slopes = (torch.from_numpy(np.ascontiguousarray(x)) for x in arrays)
        self.at = lru_cache(MOST_POSES)(self._at)

    def _at(self, pose: HandPose | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The places a (N, 3), the axes B (3, 3), A and its rotations (N, 3, 3) of the units at :attr:`rest`."""
        count, identity = len(self.rest), torch.eye(3)
        if pose is None:
            return self.rest, identity, identity.expand(count, 3, 3), identity.expand(count, 3, 3)
        whole = self.with_still(HandPose(*(x.double().cpu() for x in (pose.rotations, pose.origins, pose.centres))))
        moved = whole.move(self._pins, self._holder)
        origin, centre = self._pins.mean(0), moved.mean(0)
        offset = self._pins - origin
        spread = offset.mT @ offset
        spread = spread + 1e-6 * torch.linalg.matrix_norm(spread, 2) * torch.eye(3).to(spread)
        base = whole.rotations[0]
        if self._modes is not None:
            base = polar_rotation((moved - centre).mT @ offset @ torch.linalg.inv(spread))
        displacement, slope = torch.zeros(count, 3).double(), torch.zeros(count, 3, 3).double()
        if self._modes is not None and self._slopes is not None:
            shifted = whole.move(self._centres, torch.arange(len(self._centres)))
            shift = (shifted - centre) @ base - (self._centres - origin)
            turn = torch.stack([rotation_vector(base.mT @ r) for r in whole.rotations])
            amount = torch.cat((shift, turn), 1)
            displacement = torch.einsum("nagc,gc->na", self._modes, amount)
            slope = torch.einsum("nabgc,gc->nab", self._slopes, amount)
        place = centre + (self.rest.double() - origin + displacement) @ base.mT
        gradient = base @ (torch.eye(3).double() + slope)
        return place.float(), base.float(), gradient.float(), polar_rotation(gradient).float()

    def kernels(self, pose: HandPose | None) -> Float[Tensor, "K 3"]:
        """Displacement of all kernels of the scene by the static shape [scene units]."""
        place, _, gradient, _ = self.at(pose)
        own = self.of_kernel >= 0
        unit, rest = self.of_kernel[own], self._scene_rest[own]
        moved = place[unit] - rest + apply(gradient[unit], rest - self.rest[unit])
        return torch.zeros_like(self._scene_rest).masked_scatter(own[:, None], moved.to(self._scene_rest))

    def with_still(self, pose: HandPose) -> HandPose:
        """The pose with the pins that nobody moves as its last hand."""
        missing = int(self._holder.max()) + 1 - len(pose.rotations)
        if not missing:
            return pose
        still = torch.zeros(1, 3).to(pose.centres)
        return HandPose(
            torch.cat((pose.rotations, torch.eye(3)[None].to(pose.rotations))),
            torch.cat((pose.origins, still)), torch.cat((pose.centres, still)),
        )  # fmt: skip


class HeldBody(Body):
    """A member in hands, which begins at rest: undeformed it is not turned."""

    def __init__(
        self,
        shape: StaticShape,
        kernels: Float[Tensor, "K 3"],
        rest: Float[Tensor, "N 3"],
        gravity: Float[Tensor, " 3"],
        contact: Contact | None,
        elasticity: Elasticity,
    ) -> None:
        """Stores the constants.

        Args:
            shape: the static shape of the scene.
            kernels: rest positions of all kernels [scene units].
            rest: those of the finest units, X.
            gravity: [scene units / frame^2].
            contact: the floor; None: there is none.
            elasticity: how the body yields to a contact.
        """
        super().__init__(rest)
        self.shape, self.kernels, self.unit_of_kernel = shape, kernels, elasticity.unit_of_kernel
        self.gravity, self.contact, self.elasticity = gravity, contact, elasticity
        self.of = shape.of.to(kernels.device)

    def at(self, pose: HandPose | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As :meth:`StaticShape._at`, at the units' centres of mass, which depend on the learned densities."""
        place, axes, gradient, turns = (x.to(self.units) for x in self.shape.at(pose))
        offset = self.units - self.shape.rest.to(self.units)
        return place + apply(gradient, offset), axes, gradient, turns

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: HandMotion | None) -> "HeldMotion":
        """The units relative to the static shape, and the load of its acceleration, gravity and slope in its axes."""
        return HeldMotion(self, now, before, state, hands or HandMotion(None, None, None))


class HeldMotion(Carried):
    """One step of a body in hands."""

    def __init__(self, body: HeldBody, now: Tensor, before: Tensor, state: SimState, hands: HandMotion) -> None:
        self.body, self.state, self.hands = body, state, hands
        last, present, self.after = (body.at(pose) for pose in hands)
        acceleration = self.after[0] - 2 * present[0] + last[0] - body.gravity
        pull = -acceleration @ present[1] - body.gravity  # at rest the body is in equilibrium with gravity
        slopes = [axes.mT @ gradient for _, axes, gradient, _ in (last, present, present, self.after)]
        slope = torch.stack(slopes).mean(0) - torch.eye(3).to(pull)  # weighted as the trapezoidal rule does
        load = torch.cat((pull, slope.flatten(1)), 1)
        floor = None if body.contact is None else body.contact.nearness(now, present[1])
        shown, shown_before = body.units + (now - present[0]) @ present[1], body.units + (before - last[0]) @ last[1]
        super().__init__(UnitMotion(body.units, shown, shown_before, load, floor))

    def place(self, frame: Frame) -> Frame:
        """The prediction about the static shape at t + 1; pinned kernels go where their hands are; then the floor."""
        body, identity = self.body, torch.eye(3).to(frame.positions)
        nowhere, axes, unit = body.units.new_zeros(1, 3), self.after[1], body.unit_of_kernel
        place, units = torch.cat((self.after[0], nowhere)), torch.cat((body.units, nowhere))
        gradient, turns = (torch.cat((x, identity[None])) for x in self.after[2:])
        static = place[unit] + apply(gradient[unit], body.kernels - units[unit])
        positions = static + (frame.positions - body.kernels) @ axes.mT
        if self.hands.after is not None:
            pose = body.shape.with_still(self.hands.after.to(positions))
            positions = torch.where((body.of < 0)[:, None], positions, pose.move(body.kernels, body.of.clamp_min(0)))
        deformation = gradient + axes @ (frame.deformation_gradients - identity)
        frame = Frame(positions, deformation, turns @ frame.rotations)
        if body.contact is None:
            return frame
        return body.contact.resolve(frame, self.state, body.elasticity, axes, None)
