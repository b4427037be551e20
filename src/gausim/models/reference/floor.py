"""Contact with a floor: impulses at the lowest kernels, shared by the modes and the rigid motion of the body.

An impact is shorter than a frame, so it is followed in substeps h. Within a frame the body deviates by coordinates q,
amplitudes of its modes and a rigid motion, from the path it would take without the floor:

    (M + h^2 K / 4 + h D / 2) (q_{i+1} - 2 q_i + q_{i-1}) = -h^2 K q_i - h D (q_i - q_{i-1}) + J^T p   [frame units]

J are the displacements of the contact points per coordinate, along the normal and two tangents. The impulses p obey
Signorini's and Coulomb's laws for the gap g, which is at least g_min, and the sliding s in a substep,

    p_n >= 0, g >= g_min, p_n (g - g_min) = 0        |p_t| <= mu p_n, against s

and are found by projected gradients on the friction cones (Mazhar, Heyn, Negrut and Tasora 2015). Loss gradients are
those of the linear equations that hold as long as the same points press, stick and slide, on a softer floor: how the
impulse is shared among near points is almost undetermined, and its exact derivatives would drown all others.

After the frame the body has the deviation q and its velocity v. The trapezoidal step of a frame keeps the amplitude of
every mode if it starts from q at t + 1 and, at t, from q - (M + K / 4)^-1 (K q / 2 + M v).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import Floor, Frame, SimState
from gausim.models.reference.reference import turned_units
from gausim.ops.deformation import apply
from gausim.ops.rotation import cross_matrix, rotation_of

# Added to the diagonal of J (M + ...)^-1 J^T, as a fraction of its mean: near contact points are hardly independent.
COMPLIANCE = 1e-3
# The same for the equations that loss gradients are taken from.
GRADIENT_COMPLIANCE = 0.05
SUBSTEPS, ITERATIONS = 8, 30
# A unit takes part in a frame's contact if its lowest kernel comes nearer to the floor [fractions of the body's size].
NEAR = 0.05
# Height below which the network notices the floor [diagonals].
REACH = 0.2
# Part of the friction cone's radius above which a point slides.
SLIDING = 0.999


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Matrices of a body's modes, and how kernels follow them."""

    unit_of_kernel: Int[Tensor, " K"]  # N (the identity row) for kernels that never move
    offset: Float[Tensor, "K 3"]  # X_k - X_c [scene units]
    modes: Float[Tensor, "N 3 M"]  # displacements of units per mode, in the reference's axes; M may be 0
    slopes: Float[Tensor, "N 3 3 M"]  # and their gradients [1 / scene units]
    matrices: tuple[Tensor, Tensor, Tensor]  # inertia, stiffness and damping, each (M, M) [frame units]
    mass: Float[Tensor, ""]  # of the whole body, in the modes' units
    fraction: Float[Tensor, " K"]  # of every kernel, of the whole
    free: bool  # whether the body moves as a whole


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates of a body's deviation in one frame: its modes, and six of its rigid motion where it is free."""

    body: Elasticity
    rotation: Float[Tensor, "3 3"]  # from the modes' axes to scene axes
    centre: Float[Tensor, " 3"] | None  # of a free body
    inertia: Float[Tensor, "C C"]
    stiffness: Float[Tensor, "C C"]
    damping: Float[Tensor, "C C"]

    @classmethod
    def of(
        cls, body: Elasticity, positions: Float[Tensor, "K 3"], rotation: Float[Tensor, "3 3"], centre: Tensor | None
    ) -> "Coordinates":
        """The coordinates about the ``positions`` of a frame."""
        inertia, stiffness, damping = body.matrices
        if body.free and centre is not None:
            arm = positions - centre
            square = (body.fraction * arm.square().sum(-1)).sum()
            turning = square * torch.eye(3).to(arm) - arm.mT @ (body.fraction[:, None] * arm)
            none = arm.new_zeros(6, 6)
            rigid = torch.block_diag(torch.eye(3).to(arm), turning) * body.mass
            inertia = torch.block_diag(inertia, rigid)
            stiffness, damping = torch.block_diag(stiffness, none), torch.block_diag(damping, none)
        return cls(body, rotation, centre, inertia, stiffness, damping)

    def jacobian(
        self, points: Int[Tensor, " P"], positions: Float[Tensor, "K 3"], axes: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "P3 C"]:
        """Displacements of kernels along the axes per coordinate."""
        body, unit = self.body, self.body.unit_of_kernel[points]
        local = body.modes[unit] + torch.einsum("cabm,cb->cam", body.slopes[unit], body.offset[points])
        rows = torch.einsum("da,ab,cbm->cdm", axes, self.rotation, local)
        if self.centre is not None:
            arms = -axes @ cross_matrix(positions[points] - self.centre)
            rows = torch.cat((rows, axes.expand(len(points), 3, 3), arms), -1)
        return rows.flatten(0, 1)

    def applied(
        self, positions: Float[Tensor, "K 3"], amount: Float[Tensor, " C"]
    ) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "R 3 3"], Float[Tensor, "3 3"]]:
        """Displaced kernels, the change of the units' deformation gradients, and the rotation of the whole."""
        body, unit = self.body, self.body.unit_of_kernel
        modal, none = amount[: body.modes.shape[-1]], positions.new_zeros(1, 3, 3)
        shift = torch.einsum("ab,nbm,m->na", self.rotation, body.modes, modal)
        slope = torch.cat((torch.einsum("ab,nbcm,m->nac", self.rotation, body.slopes, modal), none))
        moved = positions + torch.cat((shift, none[0, :1]))[unit] + apply(slope[unit], body.offset)
        turn = torch.eye(3).to(positions)
        if self.centre is not None:
            rigid, turn = amount[-6:], rotation_of(amount[-3:])
            moved = moved - (body.fraction[:, None] * (moved - positions)).sum(0)  # modes keep the centre of mass
            moved = self.centre + rigid[:3] + (moved - self.centre) @ turn.mT
        return torch.where((unit == len(body.modes))[:, None], positions, moved), slope, turn


@dataclass(frozen=True, eq=False)
class Contact:
    """A floor with its coefficients."""

    floor: Floor
    friction: Float[Tensor, ""]
    restitution: Float[Tensor, ""]
    diagonal: float  # of the scene [scene units]

    def nearness(self, centres: Float[Tensor, "N 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N 4"]:
        """Nearness p = (1 - h / (0.2 diagonals))^2 of units at height h, 0 beyond; and p times the turned-back normal.

        Args:
            centres: centres of mass of the units, in the scene [scene units].
            rotation: from the axes of the body to scene axes.
        """
        near = (1 - self.floor.height(centres) / (REACH * self.diagonal)).clamp(0, 1).square()[:, None]
        return torch.cat((near, near * (centres.new_tensor(self.floor.normal) @ rotation)), 1)

    def resolve(
        self, frame: Frame, state: SimState, body: Elasticity, rotation: Float[Tensor, "3 3"], centre: Tensor | None
    ) -> Frame:
        """A predicted frame, with the impulses of the floor; no kernel is left below it.

        Args:
            frame: the prediction without the floor, in scene axes.
            state: positions at t and t - 1.
            body: how the body yields.
            rotation: from the modes' axes to scene axes.
            centre: centre of mass (3,) of a free body at t + 1; None for a held one.
        """
        points = self._points(frame.positions, state, body)
        if len(points):
            coordinates = Coordinates.of(body, frame.positions, rotation, centre)
            now, before = self._deviation(frame, state, coordinates, points)
            moved, slope, turn = coordinates.applied(frame.positions, now)
            earlier, _, _ = coordinates.applied(state.positions, before)
            deformation = turned_units(turn, frame.deformation_gradients + slope)
            rotations = turned_units(turn, frame.rotations)
            frame = Frame(moved, deformation, rotations, SimState(moved, earlier))
        moving = body.unit_of_kernel < len(body.modes)
        below = torch.where(moving, -self.floor.height(frame.positions), 0.0).clamp_min(0)[:, None]
        lift = below * frame.positions.new_tensor(self.floor.normal)
        positions = frame.positions + lift
        following = None if frame.state is None else SimState(positions, frame.state.previous + lift)
        return replace(frame, positions=positions, state=following)

    def _points(self, x: Float[Tensor, "K 3"], state: SimState, body: Elasticity) -> Int[Tensor, " P"]:
        """The lowest kernel of every unit that comes near the floor; none if nothing would touch it."""
        moving = body.unit_of_kernel < len(body.modes)
        gap = torch.where(moving, torch.minimum(self.floor.height(x), self.floor.height(state.positions)), torch.inf)
        gap, size = gap.detach(), float(body.offset.detach().norm(dim=1).max()) + 1e-12
        if not bool((gap < -1e-6 * size).any()):
            return torch.zeros(0, dtype=torch.long, device=x.device)
        return _lowest(gap, body, NEAR * size)

    def _deviation(
        self, frame: Frame, state: SimState, coordinates: Coordinates, points: Int[Tensor, " P"]
    ) -> tuple[Float[Tensor, " C"], Float[Tensor, " C"]]:
        """The deviation at t + 1, and at t as the next frame has to see it."""
        axes, h = _axes(frame.positions.new_tensor(self.floor.normal)), 1.0 / SUBSTEPS
        jacobian = coordinates.jacobian(points, frame.positions, axes)
        inertia, stiffness, damping = coordinates.inertia, coordinates.stiffness, coordinates.damping
        response = torch.linalg.inv(inertia + h**2 / 4 * stiffness + h / 2 * damping)
        spread = _softer(jacobian @ response @ jacobian.mT, COMPLIANCE)
        start, end = (
            (x[points] - x.new_tensor(self.floor.point)) @ axes.mT for x in (state.positions, frame.positions)
        )
        bent = end - 2 * start + (state.previous[points] - start.new_tensor(self.floor.point)) @ axes.mT
        paths = [start + i * h * (end - start) + 0.5 * i * h * (i * h - 1) * bent for i in range(-1, SUBSTEPS + 1)]
        q = last = jacobian.new_zeros(jacobian.shape[1])
        place, before = paths[1].flatten(), paths[0].flatten()
        impulse = torch.zeros(len(spread), dtype=torch.float64, device=spread.device)
        for path in paths[2:]:
            force = -(h**2) * (stiffness @ q) - h * (damping @ (q - last))
            ahead = 2 * q - last + response @ force
            reached = path.flatten() + jacobian @ ahead
            p, impulse = self._impulses(spread, self._wanted(reached, place, before), impulse)
            q, last = ahead + response @ (jacobian.mT @ p), q
            before, place = place, path.flatten() + jacobian @ q
        speed = (q - last) / h - 0.5 * h * torch.linalg.solve(inertia, stiffness @ q + damping @ (q - last) / h)
        seen = torch.linalg.solve(inertia + stiffness / 4, 0.5 * (stiffness @ q) + inertia @ speed)
        return q, q - seen

    def _wanted(self, reached: Tensor, place: Tensor, before: Tensor) -> Float[Tensor, " P3"]:
        """What impulses have to undo: depth below the wanted gap, and sliding, of every contact point."""
        gap, last = place.view(-1, 3)[:, 0], before.view(-1, 3)[:, 0]
        bounce = self.restitution * (gap.clamp_min(0) + (last - gap).clamp_min(0))
        slid = (reached - place).view(-1, 3)[:, 1:]
        return torch.cat(((reached.view(-1, 3)[:, 0] - bounce)[:, None], slid), 1).flatten()

    def _impulses(
        self, spread: Float[Tensor, "D D"], wanted: Float[Tensor, " D"], guess: Float[Tensor, " D"]
    ) -> tuple[Float[Tensor, " D"], Float[Tensor, " D"]]:
        """Impulses of all contact points, each along the normal and two tangents; and in double precision."""
        with torch.no_grad():
            if not bool((wanted.view(-1, 3)[:, 0] < 0).any()):
                return torch.zeros_like(wanted), torch.zeros_like(guess)
            friction = float(self.friction)
            solved = _projected_gradients(spread.double(), wanted.double(), friction, guess)
            impulses = solved.view(-1, 3)
            size = impulses[:, 1:].norm(dim=1)
            pressing = impulses[:, 0] > 1e-9 * impulses[:, 0].max().clamp_min(1e-30)
            sliding = pressing & (size >= SLIDING * friction * impulses[:, 0])
            direction = (impulses[:, 1:] / size.clamp_min(1e-30)[:, None]).to(wanted)
        if not torch.is_grad_enabled():
            return solved.to(wanted), solved
        softer = _softer(spread, GRADIENT_COMPLIANCE)
        equal = _solved(softer, wanted, pressing, sliding, direction * self.friction)
        return solved.to(wanted) + (equal - equal.detach()), solved


def _lowest(gap: Float[Tensor, " K"], body: Elasticity, near: float) -> Int[Tensor, " P"]:
    """The lowest kernel of each unit that has one nearer to the floor than ``near``."""
    inside = (gap < near).nonzero()[:, 0]
    order = inside[gap[inside].argsort(stable=True)]
    unit = body.unit_of_kernel[order]
    sort = unit.argsort(stable=True)
    first = torch.ones_like(unit, dtype=torch.bool)
    first[1:] = unit[sort][1:] != unit[sort][:-1]
    return order[sort[first]]


def _softer(spread: Float[Tensor, "D D"], compliance: float) -> Float[Tensor, "D D"]:
    return spread + compliance * spread.diagonal().mean() * torch.eye(len(spread)).to(spread)


def _axes(normal: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The normal and two tangents, as rows."""
    along = torch.eye(3).to(normal)[int(normal.abs().argmin())]
    first = torch.linalg.cross(normal, along)
    first = first / first.norm()
    return torch.stack((normal, first, torch.linalg.cross(normal, first)))


def _projected_gradients(
    w: Float[Tensor, "D D"], b: Float[Tensor, " D"], friction: float, guess: Float[Tensor, " D"]
) -> Float[Tensor, " D"]:
    """Minimum of p^T W p / 2 + p^T b over the friction cones, by accelerated projected gradients from a guess."""
    rate = 1 / float(torch.linalg.matrix_norm(w, torch.inf))
    p = y = guess
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
