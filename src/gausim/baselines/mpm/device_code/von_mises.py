"""Von Mises plasticity: the deviatoric stress is bounded."""

import warp as wp

from gausim.baselines.mpm.device_code.matrices import exp_symmetric, hencky_strain, identity

TINY = wp.constant(1.0e-12)


@wp.func
def deviator(H: wp.mat33) -> wp.mat33:
    """H - tr(H) / 3 I."""
    return H - (wp.trace(H) / 3.0) * identity()


@wp.func
def deviator_norm(D: wp.mat33) -> float:
    """Frobenius norm, with a finite derivative at zero."""
    return wp.sqrt(wp.ddot(D, D) + TINY * TINY)


@wp.func
def plastic_flow(F: wp.mat33, mu: float, yield_stress: float) -> float:
    """Amount max(|dev H| - y / (2 mu), 0) by which the strain exceeds the yield surface |dev tau| = y."""
    return wp.max(deviator_norm(deviator(hencky_strain(F))) - yield_stress / (2.0 * mu), 0.0)


@wp.func
def von_mises(F: wp.mat33, mu: float, yield_stress: float) -> wp.mat33:
    """F with its deviatoric strain taken back to the yield surface: exp(-flow n) F, n = dev H / |dev H|."""
    result = F
    D = deviator(hencky_strain(F))
    size = deviator_norm(D)
    excess = size - yield_stress / (2.0 * mu)
    if excess > 0.0 and yield_stress > 0.0:
        result = exp_symmetric((-excess / size) * D) * F
    return result
