"""The step that all modal templates have in common: one scene in modal coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.models.template.finite_strain import lame, stress

# Least part of an impulse that damping leaves in its first frame.
LEAST_LEFT = 0.1
# A step of a fit is solved when a correction is below this part of its motion, its loss gradient likewise; most
# corrections; ratio of two corrections in a row from which on stiffness is computed again.
SOLVED, SOLVED_GRADIENT, MOST, SLOW = 3e-3, 3e-2, 30, 0.4


class NonlinearForce(Protocol):
    """What a body's forces are beyond those of small displacements (:mod:`gausim.models.template.springs`)."""

    def reference_strain(self, strain: Tensor) -> Tensor:
        """What a strain (S, N, 9) of the reference changes."""

    def strain_state(self, z: Tensor, reference: Tensor | None = None) -> Any:
        """The body in a state of the modes (S, M)."""

    def between(self, first: Any, second: Any, factor: Tensor, damping: Tensor | float = 0.0) -> Tensor:
        """Mean force (S, M) from one state to another."""

    def stiffening(
        self, first: Any, second: Any, factor: Tensor, damping: Tensor | float = 0.0, *, buckling: bool = False
    ) -> Tensor:
        """By how much it makes the body stiffer (S, M, M); with ``buckling``, also where it makes it softer."""

    def potential(self, state: Any, factor: Tensor) -> Tensor:
        """Potential energy (S,)."""

    def dissipated(self, first: Any, second: Any, factor: Tensor, damping: Tensor | float) -> Tensor:
        """Energy (S,) that the damping takes."""


class Solved(NamedTuple):
    """A solved step."""

    after: Float[Tensor, "S M"]  # z_{t+1}
    bend: Float[Tensor, "S M"]  # z_{t+1} - 2 z_t + z_{t-1}, nearly
    inverse: Float[Tensor, "S M M"]  # with which it was solved


class _Correction(torch.autograd.Function):
    """A last correction ``inverse @ residual``; the residual gets A^-T of the loss gradient, A minus its derivative."""

    @staticmethod
    def forward(ctx: Any, residual: Tensor, inverse: Tensor, adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.adjoint = adjoint
        return _product(inverse, residual)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> Any:
        return ctx.adjoint(slope), None, None


def _product(matrix: Float[Tensor, "S M M"], vector: Float[Tensor, "S M"]) -> Float[Tensor, "S M"]:
    return (matrix @ vector[..., None])[..., 0]


def _inverse_adjoint(slope: Tensor, apply: Callable[[Tensor], Tensor], inverse: Tensor) -> Float[Tensor, "S M"]:
    """A^-T ``slope`` of A^T = ``apply``, by corrections with nearly the inverse of A, while they become smaller."""
    change = found = _product(inverse.mT, slope)
    for _ in range(MOST):
        last, change = change, _product(inverse.mT, slope - apply(found))
        shrinks = change.square().sum(-1) < last.square().sum(-1)
        found = found + shrinks[:, None] * change
        if not bool((shrinks & (change.norm(dim=-1) > SOLVED_GRADIENT * found.norm(dim=-1))).any()):
            break
    return found


class ModalScene:
    """Template of one scene in modal coordinates z between two updates of the parameters, for S sequences at once."""

    mass: Float[Tensor, "M M"]  # modal mass [frame units]
    inertia: Float[Tensor, "M M"]  # modal inertia: the mass, but where a template slows modes too fast for frames
    stiffness: Float[Tensor, "M M"]  # modal stiffness at rest
    damping: Float[Tensor, "M M"]  # modal damping
    nonlinear: NonlinearForce  # of springs, or of finite strain
    factor: Tensor  # on its stiffness: of the springs, one or one of each (E,); of the units' shear and volume (N, 2)
    growth: Tensor | float = 0.0  # resistance to the growth of length or strain over that to it [frames]
    # Corrections of a step; for all but the last stiffness is computed. The first is that of the state at the start. It
    # misses how far the body turns within the frame: where it is far stiffer than inertia, corrections with it alone do
    # not converge. With the others, between the ends of the frame, they do.
    corrections = 3
    solved = SOLVED

    def __init__(
        self, projection: Float[Tensor, "N 3 M"], modes: Float[Tensor, "N 3 M"], gradients: Float[Tensor, "N 3 3 M"]
    ) -> None:
        """Stores the map from displacements to z, and those from z to displacements and displacement gradients."""
        self.projection = projection.flatten(0, 1)
        # Displacements and displacement gradients of a unit side by side: one product gives both.
        self.motions = torch.cat((modes, gradients.flatten(1, 2)), 1).flatten(0, 1)

    def __call__(
        self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"], load: Float[Tensor, "S N 12"] | None = None
    ) -> Float[Tensor, "S N 12"]:
        """Displacement (3) and displacement gradient (9, row by row) of every unit at t + 1."""
        after = self.after(*self.coordinates(now, before), load)
        return (after @ self.motions.mT).view(*now.shape[:2], 12)

    def force(self, load: Float[Tensor, "S N 12"]) -> Float[Tensor, "S M"]:
        """Modal force of a load; here Phi^T M a of the part of its accelerations a that is within the modes."""
        return (load[..., :3].flatten(1) @ self.projection) @ self.mass.mT

    def coordinates(
        self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]
    ) -> tuple[Float[Tensor, "S M"], Float[Tensor, "S M"]]:
        """z_t and z_{t-1}."""
        z, previous = (torch.cat((now, before)).flatten(1) @ self.projection).chunk(2)
        return z, previous

    def carried(self, displacement: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 3"]:
        """The part of a displacement that is input to template and network; here all of it."""
        return displacement

    def correction_unit(self) -> Float[Tensor, ""] | None:
        """Factor on the network's output; None for a factor of 1."""
        return None

    def after(
        self, z: Float[Tensor, "S M"], previous: Float[Tensor, "S M"], load: Float[Tensor, "S N 12"] | None = None
    ) -> Float[Tensor, "S M"]:
        """z_{t+1}, under a load (:class:`gausim.models.reference.reference.UnitMotion`).

        A step of the trapezoidal rule, with the mean f of the nonlinear force between m_- = (z_t + z_{t-1}) / 2 and
        m_+ = (z_{t+1} + z_t) / 2:

            M (z_{t+1} - 2 z_t + z_{t-1}) = f(m_-, m_+) - K (m_- + m_+) / 2 - D (z_{t+1} - z_{t-1}) / 2 + load

        Resistance to growth is part of f. Without damping and load a step conserves :meth:`energy` exactly.
        """
        law, factor, damping = self.nonlinear, self.factor, self.growth
        speed, bend = z - previous, torch.zeros_like(z)
        reference, force, linear = self._known(z, speed, load)
        first = law.strain_state(z - speed / 2, reference)
        used = z.new_zeros(0)
        for correction in range(self.corrections):
            second = law.strain_state(z + (speed + bend) / 2, reference)
            if correction < self.corrections - 1:
                ends = (first, second) if correction else 2 * (law.strain_state(z, reference),)
                used = self._inverse(linear, *ends)
            bend = bend + _product(used, force + law.between(first, second, factor, damping) - bend @ linear.mT)
        return z + speed + bend

    def _known(self, z: Tensor, speed: Tensor, load: Tensor | None) -> tuple[Tensor | None, Tensor, Tensor]:
        """Strain of the reference, force on the body at ``speed`` without what is nonlinear, and linear operator."""
        reference, force = None, -(z @ self.stiffness.mT) - speed @ self.damping.mT
        if load is not None:
            reference, force = self.nonlinear.reference_strain(load[..., 3:]), force + self.force(load)
        return reference, force, self.inertia + self.stiffness / 4 + self.damping / 2

    @torch.no_grad()
    def _inverse(self, linear: Float[Tensor, "M M"], first: Any, second: Any) -> Float[Tensor, "S M M"]:
        operator = linear + self.nonlinear.stiffening(first, second, self.factor, self.growth) / 4
        return torch.linalg.inv_ex(operator)[0]  # without waiting for a device

    def solve(
        self,
        z: Float[Tensor, "S M"],
        previous: Float[Tensor, "S M"],
        load: Float[Tensor, "S N 12"] | None = None,
        near: Solved | None = None,
    ) -> Solved:
        """The step of :meth:`after`, solved to a tolerance; loss gradients are those of the implicit function.

        ``near`` is nearly the same step. Stiffness, which takes most of the time, is computed again only where
        corrections become smaller too slowly.
        """
        law, factor, damping, speed = self.nonlinear, self.factor, self.growth, z - previous
        reference, force, linear = self._known(z, speed, load)
        with torch.no_grad():
            first, slow = law.strain_state(z - speed / 2, reference), False
            bend, used = (torch.zeros_like(z), None) if near is None else (near.bend, near.inverse)
            least, last = self.solved * speed.norm(dim=-1), None
            for correction in range(MOST):
                second = law.strain_state(z + (speed + bend) / 2, reference)
                if used is None or slow:
                    ends = (first, second) if correction else 2 * (law.strain_state(z, reference),)
                    used = self._inverse(linear, *ends)
                change = _product(used, force + law.between(first, second, factor, damping) - bend @ linear.mT)
                bend, size = bend + change, change.norm(dim=-1)
                if bool((size <= torch.maximum(least, self.solved * (speed + bend).norm(dim=-1))).all()):
                    break
                slow, last = last is not None and not bool((size <= SLOW * last).all()), size
            assert used is not None
            inverse = used

        def adjoint(slope: Tensor) -> Tensor:
            """A^-T of a loss gradient, A minus the residual's derivative."""

            def apply(found: Tensor) -> Tensor:
                return found @ linear - torch.autograd.grad(pull, moved, found, retain_graph=True)[0]

            return _inverse_adjoint(slope, apply, inverse)

        moved = bend.clone().requires_grad_(torch.is_grad_enabled())
        first, second = (law.strain_state(place, reference) for place in (z - speed / 2, z + (speed + moved) / 2))
        pull = law.between(first, second, factor, damping)
        left = force + pull - bend @ linear.mT
        return Solved(z + speed + bend + _Correction.apply(left, inverse, adjoint), bend, inverse)

    def derivatives(
        self, previous: Float[Tensor, "S M"], z: Float[Tensor, "S M"], after: Float[Tensor, "S M"]
    ) -> tuple[Float[Tensor, "S M M"], Float[Tensor, "S M M"]]:
        """Derivatives of z_{t+1} with respect to z_{t-1} and to z_t, at a step without load."""
        law, factor, damping = self.nonlinear, self.factor, self.growth
        first, second = (law.strain_state((z + end) / 2) for end in (previous, after))
        ahead = law.stiffening(first, second, factor, damping, buckling=True) / 4
        behind = law.stiffening(second, first, factor, -damping, buckling=True) / 4
        lost, quarter = self.damping / 2, self.stiffness / 4
        inverse = torch.linalg.inv_ex(self.inertia + quarter + lost + ahead)[0]
        return (
            inverse @ (lost - self.inertia - quarter - behind),
            inverse @ (2 * (self.inertia - quarter) - ahead - behind),
        )

    def overshoot(self, displacement: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 3"]:
        """The part of a displacement by an impulse that its frame does not reach.

        Of its modal coordinates z these are z - (M + K / 4)^-1 M z / (1 - t), M after the inverse being the mass.
        A mode of angular frequency w that gets a velocity v thus begins with v / (1 + w^2 / 4), with which a motion of
        the trapezoidal rule is as large as the true one, v / w. With all of v modes far above the frame rate would turn
        round by v in every frame. 1 - t is what damping leaves of it in this step, for the slow modes: with it, a
        steady force ends where stiffness balances it.
        """
        z = (displacement.flatten(1) @ self.projection).mT
        return ((z - self._reached @ z).mT @ self.motions.mT).unflatten(1, (-1, 12))[..., :3]

    @cached_property
    def _reached(self) -> Float[Tensor, "M M"]:
        whole = self.inertia + self.stiffness / 4
        inverse, slow = (torch.linalg.inv_ex(a)[0] for a in (whole, self.stiffness))  # without waiting for a device
        lost = (slow * self.damping).sum() / (2 * (slow * whole).sum())
        return inverse @ self.mass / (1 - lost).clamp_min(LEAST_LEFT)

    def energy(self, z: Float[Tensor, "S M"], previous: Float[Tensor, "S M"]) -> Float[Tensor, " S"]:
        """v^T M v / 2 + m^T K m / 2 + the nonlinear part, with v = z_t - z_{t-1} and m = (z_t + z_{t-1}) / 2.

        Only the state receives loss gradients.
        """
        step, middle = z - previous, (z + previous) / 2
        inertia, stiffness, factor = self.inertia.detach(), self.stiffness.detach(), self.factor.detach()
        energy = 0.5 * ((step @ inertia) * step).sum(-1) + 0.5 * ((middle @ stiffness) * middle).sum(-1)
        return energy + self.nonlinear.potential(self.nonlinear.strain_state(middle), factor)

    def dissipated(
        self, after: Float[Tensor, "S M"], now: Float[Tensor, "S M"], previous: Float[Tensor, "S M"]
    ) -> Float[Tensor, " S"]:
        """Energy lost to damping in a step: v^T D v of v = (z_{t+1} - z_{t-1}) / 2, and to growth."""
        speed, law = (after - previous) / 2, self.nonlinear
        first, second = (law.strain_state((now + end) / 2) for end in (previous, after))
        taken = law.dissipated(first, second, self.factor, self.growth)
        return ((speed @ self.damping) * speed).sum(-1) + taken


def force_of_strain(
    strain: Float[Tensor, "S N 9"], uneven: Float[Tensor, "N 2"], modes: Float[Tensor, "N 9 M"]
) -> Float[Tensor, "S M"]:
    """-sum_n (2 mu u_n0 S_n + lambda u_n1 tr S_n) : E_n, the modal force of a strain S of the reference.

    Args:
        strain: displacement gradient S of every unit, row by row; its antisymmetric part does nothing.
        uneven: stiffness of shear and of volume beyond that of the homogeneous body [1 / frame^2].
        modes: E, strain of the modes near each unit times volume, as ``SolidBody.strains`` gives it.
    """
    return -stress(strain.unflatten(-1, (3, 3)), lame(uneven)).flatten(1) @ modes.flatten(0, 1)
