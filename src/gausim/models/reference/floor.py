"""Contact with a floor: impulses at the lowest kernels, shared by the modes and the rigid motion of the body.

A step without the floor gives the gaps g of the contact points from the plane, and their displacements s along it.
With impulses p (along the normal and two tangents) they become g + W p and s + W p, where W is the Delassus operator:
how far a contact point moves by an impulse at another, through the body's modes and its rigid motion. The impulses are
those of Signorini's and Coulomb's laws,

    p_n >= 0, g >= g_min, p_n (g - g_min) = 0        |p_t| <= mu p_n, against the sliding

found by projected gradients on the friction cones (Mazhar, Heyn, Negrut and Tasora 2015). Loss gradients are those of
the linear equations that hold as long as the same points press, stick and slide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import Floor, SimState
from gausim.ops.rotation import cross_matrix, rotation_of

if TYPE_CHECKING:
    from gausim.models.reference.reference import Placed

# Added to the diagonal of W, as a fraction of its mean: contact points close together are hardly independent.
COMPLIANCE = 1e-3
ITERATIONS = 60
# Rounds of contact points: the impulses of one may press another kernel into the floor.
ROUNDS = 3
# Depth below which a kernel is in contact [fractions of the body's size].
SHALLOW = 1e-6
# Part of the friction cone's radius above which a point slides.
SLIDING = 0.999


@dataclass(frozen=True, eq=False)
class Elasticity:
    """How a body yields to impulses at its kernels within one step."""

    unit_of_kernel: Int[Tensor, " K"]  # N (the identity row) for kernels that never move
    offset: Float[Tensor, "K 3"]  # X_k - X_c [scene units]
    modes: Float[Tensor, "N 3 M"]  # displacements of units per mode, in the reference's axes; M may be 0
    slopes: Float[Tensor, "N 3 3 M"]  # and their gradients [1 / scene units]
    response: Float[Tensor, "M M"]  # modal displacement per modal impulse [frame units]
    mass: Float[Tensor, ""]  # of the whole body, in the modes' units
    fraction: Float[Tensor, " K"]  # of every kernel, of the whole
    free: bool  # whether the body moves as a whole


@dataclass(frozen=True, eq=False)
class Contact:
    """A floor with its coefficients."""

    floor: Floor
    friction: Float[Tensor, ""]
    restitution: Float[Tensor, ""]

    def resolve(
        self,
        placed: Placed,
        state: SimState,
        body: Elasticity,
        rotation: Float[Tensor, "*N 3 3"],
        centre: Float[Tensor, " 3"] | None,
    ) -> Placed:
        """A predicted frame, with the impulses of the floor; no kernel is left below it.

        Args:
            placed: the prediction without the floor, in scene axes.
            state: positions at t and t - 1.
            body: how the body yields.
            rotation: of the whole body, or of every unit, from the modes' axes to scene axes.
            centre: centre of mass of a free body at t + 1; None for a held one.
        """
        moving = body.unit_of_kernel < len(body.modes)
        turned = rotation.expand(len(body.modes), 3, 3)
        for _ in range(ROUNDS):
            gap = torch.where(moving, self.floor.height(placed.positions), torch.inf)
            points = _lowest(gap.detach(), body, SHALLOW * float(body.offset.detach().abs().max()))
            if not len(points):
                return placed
            placed = self._pushed(placed, state, body, turned, centre, points)
        below = torch.where(moving, -self.floor.height(placed.positions), 0.0).clamp_min(0)
        lifted = placed.positions + below[:, None] * placed.positions.new_tensor(self.floor.normal)
        return placed._replace(positions=lifted)

    def _pushed(
        self, placed: Placed, state: SimState, body: Elasticity, turned: Tensor, centre: Tensor | None, points: Tensor
    ) -> Placed:
        x = placed.positions
        axes = _axes(x.new_tensor(self.floor.normal))
        unit = body.unit_of_kernel[points]
        local = body.modes[unit] + torch.einsum("cabm,cb->cam", body.slopes[unit], body.offset[points])
        modal = torch.einsum("da,cab,cbm->cdm", axes, turned[unit], local).flatten(0, 1)
        rigid = _rigid_rows(axes, x[points], centre) if body.free and centre is not None else None
        inverse = _rigid_inverse(body, x, centre) if rigid is not None and centre is not None else None
        delassus = modal @ body.response @ modal.mT
        if rigid is not None and inverse is not None:
            delassus = delassus + rigid @ inverse @ rigid.mT
        delassus = delassus + COMPLIANCE * delassus.diagonal().mean() * torch.eye(len(delassus)).to(delassus)
        impulse = self._impulses(delassus, self._wanted(x[points], state, points, axes))
        amount = body.response @ (modal.mT @ impulse)
        shift = torch.cat((torch.einsum("nab,nbm,m->na", turned, body.modes, amount), x.new_zeros(1, 3)))
        slope = torch.cat((torch.einsum("nab,nbcm,m->nac", turned, body.slopes, amount), x.new_zeros(1, 3, 3)))
        unit = body.unit_of_kernel
        moved = x + shift[unit] + (slope[unit] @ body.offset[..., None])[..., 0]
        deformation, rotations = placed.deformation_gradients + slope, placed.rotations
        if rigid is not None and inverse is not None and centre is not None:
            change = inverse @ (rigid.mT @ impulse)
            turn, still = rotation_of(change[3:]), unit == len(body.modes)
            moved = torch.where(still[:, None], x, centre + change[:3] + (moved - centre) @ turn.mT)
            deformation = torch.cat((turn @ deformation[:-1], deformation[-1:]))
            rotations = torch.cat((turn @ rotations[:-1], rotations[-1:]))
        return placed._replace(positions=moved, deformation_gradients=deformation, rotations=rotations)

    def _wanted(self, x: Tensor, state: SimState, points: Tensor, axes: Tensor) -> Float[Tensor, " C3"]:
        """What the impulses have to undo: depth below the wanted gap, and sliding, of every contact point."""
        now, before = self.floor.height(state.positions[points]), self.floor.height(state.previous[points])
        bounce = self.restitution * (now.clamp_min(0) + (before - now).clamp_min(0))
        wanted = (x - state.positions[points]) @ axes.mT
        return torch.cat((self.floor.height(x)[:, None] - bounce[:, None], wanted[:, 1:]), 1).flatten()

    def _impulses(self, delassus: Float[Tensor, "D D"], wanted: Float[Tensor, " D"]) -> Float[Tensor, " D"]:
        """Impulses of all contact points, each along the normal and two tangents."""
        with torch.no_grad():
            found = _projected_gradients(delassus.double(), wanted.double(), float(self.friction)).view(-1, 3)
            size = found[:, 1:].norm(dim=1)
            pressing = found[:, 0] > 1e-9 * found[:, 0].max().clamp_min(1e-30)
            sliding = pressing & (size >= SLIDING * float(self.friction) * found[:, 0])
            direction = (found[:, 1:] / size.clamp_min(1e-30)[:, None]).to(wanted)
        equal = _solved(delassus, wanted, pressing, sliding, direction * self.friction)
        return found.flatten().to(wanted) + (equal - equal.detach())


def _lowest(gap: Float[Tensor, " K"], body: Elasticity, depth: float) -> Int[Tensor, " C"]:
    """The lowest kernel of each unit that has one below the floor."""
    inside = (gap < -depth).nonzero()[:, 0]
    order = inside[gap[inside].argsort(stable=True)]
    unit = body.unit_of_kernel[order]
    sort = unit.argsort(stable=True)
    first = torch.ones_like(unit, dtype=torch.bool)
    first[1:] = unit[sort][1:] != unit[sort][:-1]
    return order[sort[first]]


def _axes(normal: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The normal and two tangents, as rows."""
    along = torch.eye(3).to(normal)[int(normal.abs().argmin())]
    first = torch.linalg.cross(normal, along)
    first = first / first.norm()
    return torch.stack((normal, first, torch.linalg.cross(normal, first)))


def _rigid_rows(axes: Tensor, points: Float[Tensor, "C 3"], centre: Float[Tensor, " 3"]) -> Float[Tensor, "D 6"]:
    """Displacement of the contact points along the axes per translation and rotation of the body."""
    arms = -axes @ cross_matrix(points - centre)
    return torch.cat((axes.expand(len(points), 3, 3), arms), -1).flatten(0, 1)


def _rigid_inverse(body: Elasticity, x: Float[Tensor, "K 3"], centre: Float[Tensor, " 3"]) -> Float[Tensor, "6 6"]:
    """Inverse of the mass and of the inertia tensor."""
    arm = x - centre
    square = (body.fraction * arm.square().sum(-1)).sum()
    inertia = square * torch.eye(3).to(x) - arm.mT @ (body.fraction[:, None] * arm)
    return torch.block_diag(torch.eye(3).to(x) / body.mass, torch.linalg.inv(inertia) / body.mass)


def _projected_gradients(w: Float[Tensor, "D D"], b: Float[Tensor, " D"], friction: float) -> Float[Tensor, " D"]:
    """Minimum of p^T W p / 2 + p^T b over the friction cones, by accelerated projected gradients."""
    rate = 1 / float(torch.linalg.matrix_norm(w, torch.inf))
    p = y = torch.zeros_like(b)
    momentum = 1.0
    for _ in range(ITERATIONS):
        after = _onto_cones((y - rate * (w @ y + b)).view(-1, 3), friction).flatten()
        if float((y - after) @ (after - p)) > 0:
            momentum = 1.0  # restart where momentum leads uphill (O'Donoghue and Candes 2015)
        faster = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        y = after + (momentum - 1) / faster * (after - p)
        p, momentum = after, faster
    return p


def _onto_cones(p: Float[Tensor, "C 3"], friction: float) -> Float[Tensor, "C 3"]:
    """Impulses with p_n >= 0 and |p_t| <= mu p_n."""
    normal = p[:, :1].clamp_min(0)
    size = p[:, 1:].norm(dim=1, keepdim=True)
    return torch.cat((normal, p[:, 1:] * (friction * normal / size.clamp_min(1e-30)).clamp_max(1)), 1)


def _solved(
    w: Float[Tensor, "D D"],
    b: Float[Tensor, " D"],
    pressing: Bool[Tensor, " C"],
    sliding: Bool[Tensor, " C"],
    drag: Float[Tensor, "C 2"],
) -> Float[Tensor, " D"]:
    """Impulses of the linear equations: pressing points reach their gap, sticking ones do not slide."""
    count = len(pressing)
    spread = w.new_zeros(count, 3, count, 3)
    place = torch.arange(count)
    spread[place, 0, place, 0] = 1.0
    spread[place, 1, place, 1] = spread[place, 2, place, 2] = (~sliding).to(w)
    spread[place, 1:, place, 0] = torch.where(sliding[:, None], drag, torch.zeros_like(drag))
    wanted = torch.stack((pressing, pressing & ~sliding, pressing & ~sliding), 1).flatten()
    basis = spread.view(3 * count, 3 * count)[:, wanted]
    rows = torch.eye(3 * count).to(w)[wanted]
    q = torch.linalg.solve(rows @ w @ basis, -(rows @ b))
    return basis @ q
