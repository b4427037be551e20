"""The Kirchhoff stress tau = J sigma of the elastic energy, and the polar rotation in it with its derivative.

The derivative is not that of a singular value decomposition, which is undefined where stretches are equal, as at rest.
"""

import warp as wp

POLAR_STEPS = wp.constant(20)  # at most; near rest two or three do
POLAR_TOLERANCE = wp.constant(1.0e-7)
LEAST_DETERMINANT = wp.constant(1.0e-4)  # below it Newton's iteration is not safe in float32


@wp.func
def identity() -> wp.mat33:
    """The unit matrix."""
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def _polar_by_newton(F: wp.mat33) -> wp.mat33:
    """R <- (R + R^-T) / 2 until convergence (Higham 1986)."""
    R = F
    steps = int(POLAR_STEPS)
    for _ in range(steps):
        following = 0.5 * (R + wp.transpose(wp.inverse(R)))
        change = wp.ddot(following - R, following - R)
        R = following
        if change < POLAR_TOLERANCE * POLAR_TOLERANCE:
            break
    return R


@wp.func
def _polar_by_svd(F: wp.mat33) -> wp.mat33:
    """U V^T, for det F that is tiny or negative; a reflection is mended along the axis of the smallest stretch."""
    U, _s, V = wp.svd3(F)
    R = U * wp.transpose(V)
    if wp.determinant(R) < 0.0:
        mirror = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)
        R = U * mirror * wp.transpose(V)
    return R


@wp.func
def polar_rotation(F: wp.mat33) -> wp.mat33:
    """R of F = R S, with det R = 1 whatever the sign of det F."""
    R = identity()
    if wp.determinant(F) > LEAST_DETERMINANT:
        R = _polar_by_newton(F)
    else:
        R = _polar_by_svd(F)
    return R


@wp.func_grad(polar_rotation)
def _adjoint_polar_rotation(F: wp.mat33, adjoint: wp.mat33) -> None:
    """The derivative dR = R [w]x with (tr S I - S) w = axial(R^T dF - dF^T R), transposed."""
    R = polar_rotation(F)
    S = wp.transpose(R) * F
    P = wp.transpose(R) * adjoint
    p = wp.vec3(P[2, 1] - P[1, 2], P[0, 2] - P[2, 0], P[1, 0] - P[0, 1])
    K = wp.trace(S) * identity() - S
    if wp.abs(wp.determinant(K)) > 1.0e-10:
        wp.adjoint[F] += R * wp.skew(wp.inverse(K) * p)


@wp.func
def fixed_corotated(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """Tau = 2 mu (F - R) F^T + lambda J (J - 1) I (Stomakhin et al. 2012)."""
    R = polar_rotation(F)
    J = wp.determinant(F)
    return 2.0 * mu * (F - R) * wp.transpose(F) + lam * J * (J - 1.0) * identity()
