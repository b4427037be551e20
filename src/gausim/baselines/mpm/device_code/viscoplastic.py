"""Viscoplastic flow: beyond the yield stress the shear relaxes at a rate, not at once."""

import warp as wp

from gausim.baselines.mpm.device_code.matrices import exp_symmetric, hencky_strain
from gausim.baselines.mpm.device_code.von_mises import deviator, deviator_norm

ROOT_TWO_THIRDS = wp.constant(0.816496580927726)


@wp.func
def viscoplastic(F: wp.mat33, mu: float, yield_stress: float, viscosity: float, dt: float) -> wp.mat33:
    """Herschel-Bulkley flow of exponent 1 with a von Mises yield surface (Yue et al. 2015, as in PhysGaussian).

    |s| <- |s| - (|s| - sqrt(2/3) y) / (1 + viscosity / (2 mu_hat dt)) with s = 2 mu dev H and
    mu_hat = mu tr(F F^T) / 3. Viscosity 0 is plasticity at once, infinite viscosity is elastic.
    """
    result = F
    D = deviator(hencky_strain(F))
    size = deviator_norm(D)
    excess = 2.0 * mu * size - ROOT_TWO_THIRDS * yield_stress
    if excess > 0.0:
        mu_hat = mu * wp.ddot(F, F) / 3.0
        relaxed = excess / (1.0 + viscosity / (2.0 * mu_hat * dt))
        result = exp_symmetric((-relaxed / (2.0 * mu * size)) * D) * F
    return result
