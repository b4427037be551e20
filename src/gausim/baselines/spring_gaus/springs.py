"""A net of springs between anchors and its motion over one frame, with a compiled adjoint (Spring-Gaus).

Lengths are in diagonals of the scene, times in frames, and every anchor has mass 1. A spring between a and b with
r = x_b - x_a, L = |r|, d = r / L and e = L / L_0 - 1 pulls a with

    f = (kappa L_0 e sqrt(1 + |e|) + c (v_b - v_a) . d) d,

and b with -f, so that momentum is conserved and, without damping, energy.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.kernels.announce import announced
from gausim.kernels.jit import FINITE_MATH_OFF, HELPER, KERNEL

# Springs to this number of nearest anchors are never attenuated (Spring-Gaus).
FIRM = 16


@dataclass(frozen=True, eq=False)
class Net:
    """E springs between A anchors, sorted by their first end."""

    first: Int[Tensor, " E"]  # one end
    second: Int[Tensor, " E"]  # the other end, of a higher number
    starts: Int[Tensor, " A_and_end"]  # first spring of every anchor, then E
    length: Float[Tensor, " E"]  # rest length L_0 [diagonals]
    rank: Int[Tensor, " E"]  # number of nearer neighbours at an end, 0 for its nearest; the smaller of both ends
    reach: int  # neighbours per anchor

    @staticmethod
    def of(rest: Float[Tensor, "A 3"], pinned: Tensor, neighbours: int) -> "Net":
        """Springs from every anchor to its nearest ``neighbours``, each pair once, none between two pinned ones."""
        count = len(rest)
        reach = min(neighbours, count - 1)
        _, index = cKDTree(rest.double().numpy()).query(rest.double().numpy(), k=reach + 1)
        near = torch.from_numpy(index[:, 1:]).long()
        anchor = torch.arange(count)[:, None].expand_as(near)
        rank = torch.arange(reach).expand_as(near)
        code = (torch.minimum(anchor, near) * count + torch.maximum(anchor, near)).flatten()
        pairs, place = torch.unique(code, return_inverse=True)
        best = torch.full((len(pairs),), reach).scatter_reduce_(0, place, rank.flatten(), "amin")
        first, second = pairs // count, pairs % count
        kept = ~(pinned[first] & pinned[second])
        first, second, best = first[kept], second[kept], best[kept]
        starts = torch.searchsorted(first.contiguous(), torch.arange(count + 1))
        return Net(first, second, starts, (rest[second] - rest[first]).norm(dim=1), best, reach)

    def attenuation(self, s: Float[Tensor, ""]) -> Float[Tensor, " E"]:
        """1 for the nearest :data:`FIRM`, else clamp(2 - exp(softplus(s) j / (reach - 16)), 0, 1), j = rank - 15."""
        j = (self.rank - FIRM + 1).clamp_min(0).to(s)
        fade = 2 - torch.exp(torch.nn.functional.softplus(s) * j / max(1, self.reach - FIRM))
        return fade.clamp(0, 1)

    def stiffest(self, stiffness: Float[Tensor, " E"]) -> float:
        """Upper bound of the squared angular frequency of any motion [1 / frames^2], from row sums (Gershgorin)."""
        total = torch.zeros(len(self.starts) - 1).to(stiffness)
        total = total.index_add(0, self.first, stiffness).index_add(0, self.second, stiffness)
        return 2 * float(total.max())


def forces(
    net: Net, x: Float[Tensor, "A 3"], v: Float[Tensor, "A 3"], stiffness: Float[Tensor, " E"], drag: Tensor
) -> Float[Tensor, "A 3"]:
    """Force on every anchor (plain torch)."""
    r = x[net.second] - x[net.first]
    length = r.norm(dim=1)
    d = r / length[:, None]
    e = length / net.length - 1
    pull = stiffness * net.length * e * (1 + e.abs()).sqrt() + drag * ((v[net.second] - v[net.first]) * d).sum(1)
    f = pull[:, None] * d
    return torch.zeros_like(x).index_add(0, net.first, f).index_add(0, net.second, -f)


def move_plain(
    net: Net, x: Tensor, v: Tensor, stiffness: Tensor, drag: Tensor, free: Tensor, substeps: int
) -> tuple[Tensor, Tensor]:
    """:func:`move` in plain torch: the reference, and the form for other devices."""
    dt = 1 / substeps
    for _ in range(substeps):
        v = v + dt * free * forces(net, x, v, stiffness, drag)
        x = x + dt * v
    return x, v


def move(
    net: Net,
    x: Float[Tensor, "A 3"],
    v: Float[Tensor, "A 3"],
    stiffness: Float[Tensor, " E"],
    drag: Float[Tensor, " E"],
    free: Float[Tensor, "A 1"],
    substeps: int,
) -> tuple[Float[Tensor, "A 3"], Float[Tensor, "A 3"]]:
    """Positions [diagonals] and velocities [diagonals / frame] one frame later, by semi-implicit Euler.

    Stiffness kappa is in 1 / frames^2, drag c in 1 / frames; ``free`` is 1 where an anchor moves, else 0, as its
    velocity. Differentiable in all but the net.
    """
    if x.device.type != "cpu":
        return move_plain(net, x, v, stiffness, drag, free, substeps)
    moved: tuple[Tensor, Tensor] = _Move.apply(x, v, stiffness, drag, net, free, substeps)
    return moved


class _Move(torch.autograd.Function):
    """One frame as one node of the graph: substep states are kept, forces are recomputed in the backward pass."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, v: Tensor, stiffness: Tensor, drag: Tensor, net: Net, free: Tensor, substeps: int
    ) -> tuple[Tensor, Tensor]:
        like = x.detach().numpy().dtype
        xs, vs = (np.empty((substeps + 1, *x.shape), like) for _ in range(2))
        xs[0], vs[0] = x.detach().numpy(), v.detach().numpy()
        numbers = (n.detach().numpy().astype(like) for n in (net.length, stiffness, drag))
        springs = net.starts.numpy(), net.second.numpy(), *numbers
        moving = free.detach().numpy().astype(like).reshape(-1)
        with announced("the springs"):
            _forward(xs, vs, *springs, moving, like.type(1 / substeps))
        ctx.work = xs, vs, springs, moving
        return torch.from_numpy(xs[-1].copy()), torch.from_numpy(vs[-1].copy())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Tensor | None, ...]:
        xs, vs, springs, moving = ctx.work
        gx, gv = (np.array(g.numpy(), dtype=xs.dtype, order="C") for g in incoming)
        by_stiffness, by_drag = (np.zeros(len(springs[2]), xs.dtype) for _ in range(2))
        _backward(xs, vs, *springs, moving, xs.dtype.type(1 / (len(xs) - 1)), gx, gv, by_stiffness, by_drag)
        return (*map(torch.from_numpy, (gx, gv, by_stiffness, by_drag)), None, None, None)


@numba.njit(fastmath=FINITE_MATH_OFF, **HELPER)
def _spring(x, v, a, b, rest, kappa, c, one):
    """Direction, 1 / length, stretch e, sqrt(1 + |e|), closing speed and pull; ``one`` is 1 in the type of ``x``."""
    rx, ry, rz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    length = np.sqrt(rx * rx + ry * ry + rz * rz)
    over = one / length
    dx, dy, dz = rx * over, ry * over, rz * over
    e = (length - rest) / rest
    root = np.sqrt(abs(e) + one)
    speed = (v[b, 0] - v[a, 0]) * dx + (v[b, 1] - v[a, 1]) * dy + (v[b, 2] - v[a, 2]) * dz
    return dx, dy, dz, over, e, root, speed, kappa * rest * e * root + c * speed


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def _forward(xs, vs, starts, second, rest, kappa, drag, moving, dt):
    """Fills the states of all substeps."""
    count, one = xs.shape[1], dt / dt
    force = np.empty_like(xs[0])
    for step in range(xs.shape[0] - 1):
        x, v = xs[step], vs[step]
        force[:] = 0
        for a in range(count):
            fx, fy, fz = force[a, 0], force[a, 1], force[a, 2]
            for s in range(starts[a], starts[a + 1]):
                b = second[s]
                dx, dy, dz, _, _, _, _, pull = _spring(x, v, a, b, rest[s], kappa[s], drag[s], one)
                fx += pull * dx
                fy += pull * dy
                fz += pull * dz
                force[b, 0] -= pull * dx
                force[b, 1] -= pull * dy
                force[b, 2] -= pull * dz
            force[a, 0], force[a, 1], force[a, 2] = fx, fy, fz
        for a in range(count):
            for i in range(3):
                vs[step + 1, a, i] = v[a, i] + dt * moving[a] * force[a, i]
                xs[step + 1, a, i] = x[a, i] + dt * vs[step + 1, a, i]


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def _backward(xs, vs, starts, second, rest, kappa, drag, moving, dt, gx, gv, by_kappa, by_drag):
    """Turns the loss gradients of the last state into those of the first, in place, and adds those of the springs."""
    count, one = xs.shape[1], dt / dt
    gf = np.empty_like(gx)
    for step in range(xs.shape[0] - 2, -1, -1):
        x, v = xs[step], vs[step]
        for a in range(count):
            for i in range(3):
                gv[a, i] += dt * gx[a, i]
                gf[a, i] = dt * moving[a] * gv[a, i]
        for a in range(count):
            for s in range(starts[a], starts[a + 1]):
                b = second[s]
                dx, dy, dz, over, e, root, speed, pull = _spring(x, v, a, b, rest[s], kappa[s], drag[s], one)
                px, py, pz = gf[a, 0] - gf[b, 0], gf[a, 1] - gf[b, 1], gf[a, 2] - gf[b, 2]
                along = px * dx + py * dy + pz * dz  # of the pull
                by_kappa[s] += along * rest[s] * e * root
                by_drag[s] += along * speed
                c = along * drag[s]
                # Of the direction: through the force itself and through the closing speed.
                qx = pull * px + c * (v[b, 0] - v[a, 0])
                qy = pull * py + c * (v[b, 1] - v[a, 1])
                qz = pull * pz + c * (v[b, 2] - v[a, 2])
                radial = along * kappa[s] * (root + abs(e) / (root + root)) - (qx * dx + qy * dy + qz * dz) * over
                rx, ry, rz = radial * dx + qx * over, radial * dy + qy * over, radial * dz + qz * over
                gx[a, 0] -= rx
                gx[a, 1] -= ry
                gx[a, 2] -= rz
                gx[b, 0] += rx
                gx[b, 1] += ry
                gx[b, 2] += rz
                gv[a, 0] -= c * dx
                gv[a, 1] -= c * dy
                gv[a, 2] -= c * dz
                gv[b, 0] += c * dx
                gv[b, 1] += c * dy
                gv[b, 2] += c * dz
