"""3x3 matrix functions with their derivatives: polar rotation, logarithm and exponential.

None goes through the derivative of a singular value decomposition, which is undefined where stretches are equal, that
is at rest.
"""

import warp as wp

POLAR_STEPS = wp.constant(20)  # at most; near rest two or three do
POLAR_TOLERANCE = wp.constant(1.0e-7)
LEAST_DETERMINANT = wp.constant(1.0e-4)  # below it Newton's iteration is not safe in float32
LEAST_STRETCH_SQUARED = wp.constant(1.0e-12)
# Eigenvalues this close (relative) share the derivative at their midpoint: its error is their distance squared / 12.
NEAR = wp.constant(1.0e-2)


@wp.func
def identity() -> wp.mat33:
    """The unit matrix."""
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def _polar_by_newton(F: wp.mat33) -> wp.mat33:
    """R <- (R + R^-T) / 2 until it stands still (Higham 1986)."""
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
    """U V^T of matter turned inside out; the smallest axis is turned round where that is a reflection."""
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
def spectrum(A: wp.mat33) -> tuple[wp.mat33, wp.vec3]:
    """Eigenvectors (columns) and eigenvalues of a symmetric matrix, to about 1e-5 of its size.

    One pass of Warp's ``eig3`` leaves up to 5e-3 of it beside the diagonal; the second takes that away.
    """
    first, _e = wp.eig3(A)
    second, e = wp.eig3(wp.transpose(first) * A * first)
    return first * second, e


@wp.func
def _excess(F: wp.mat33) -> wp.mat33:
    """F F^T - I from F - I, without cancellation near rest."""
    G = F - identity()
    return G + wp.transpose(G) + G * wp.transpose(G)


@wp.func
def _log_slope(a: float, b: float) -> float:
    """(log a - log b) / (a - b), and its limit."""
    slope = 2.0 / (a + b)
    if wp.abs(a - b) > NEAR * (a + b):
        slope = (wp.log(a) - wp.log(b)) / (a - b)
    return slope


@wp.func
def _exp_slope(a: float, b: float) -> float:
    """(exp a - exp b) / (a - b), and its limit."""
    slope = wp.exp(0.5 * (a + b))
    if wp.abs(a - b) > NEAR:
        slope = (wp.exp(a) - wp.exp(b)) / (a - b)
    return slope


@wp.func
def hencky_strain(F: wp.mat33) -> wp.mat33:
    """H = log(F F^T) / 2, the logarithmic strain in the deformed frame; its eigenvalues are the log stretches."""
    Q, e = spectrum(_excess(F))
    logs = wp.vec3(0.0, 0.0, 0.0)
    for i in range(3):
        logs[i] = 0.5 * wp.log(wp.max(1.0 + e[i], LEAST_STRETCH_SQUARED))
    return Q * wp.diag(logs) * wp.transpose(Q)


@wp.func_grad(hencky_strain)
def _adjoint_hencky_strain(F: wp.mat33, adjoint: wp.mat33) -> None:
    """Daleckii-Krein: in the eigenframe the derivative multiplies by divided differences."""
    Q, e = spectrum(_excess(F))
    G = wp.transpose(Q) * (0.5 * (adjoint + wp.transpose(adjoint))) * Q
    for i in range(3):
        for j in range(3):
            a = wp.max(1.0 + e[i], LEAST_STRETCH_SQUARED)
            b = wp.max(1.0 + e[j], LEAST_STRETCH_SQUARED)
            G[i, j] = 0.5 * _log_slope(a, b) * G[i, j]
    wp.adjoint[F] += 2.0 * (Q * G * wp.transpose(Q)) * F


@wp.func
def exp_symmetric(S: wp.mat33) -> wp.mat33:
    """The matrix exponential of a symmetric matrix."""
    Q, e = spectrum(S)
    less_one = wp.vec3(wp.exp(e[0]) - 1.0, wp.exp(e[1]) - 1.0, wp.exp(e[2]) - 1.0)
    return identity() + Q * wp.diag(less_one) * wp.transpose(Q)  # small S: no error of Q in the unit part


@wp.func_grad(exp_symmetric)
def _adjoint_exp_symmetric(S: wp.mat33, adjoint: wp.mat33) -> None:
    """Daleckii-Krein, as for the logarithm."""
    Q, e = spectrum(S)
    G = wp.transpose(Q) * (0.5 * (adjoint + wp.transpose(adjoint))) * Q
    for i in range(3):
        for j in range(3):
            G[i, j] = _exp_slope(e[i], e[j]) * G[i, j]
    wp.adjoint[S] += Q * G * wp.transpose(Q)
