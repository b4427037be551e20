"""Drucker-Prager plasticity of sand: shear is bounded by pressure, tension is not borne."""

import warp as wp

from gausim.baselines.mpm.device_code.matrices import exp_symmetric, hencky_strain, polar_rotation
from gausim.baselines.mpm.device_code.von_mises import deviator, deviator_norm


@wp.func
def drucker_prager(F: wp.mat33, mu: float, lam: float, friction: float) -> wp.mat33:
    """The return map of Klar et al. 2016 without its volume correction.

    Args:
        F: trial gradient.
        mu: shear modulus.
        lam: second Lame constant.
        friction: alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi)) of the friction angle phi.
    """
    result = F
    H = hencky_strain(F)
    volume = wp.trace(H)
    D = deviator(H)
    size = deviator_norm(D)
    flow = size + friction * (3.0 * lam + 2.0 * mu) / (2.0 * mu) * volume
    if volume >= 0.0:
        result = polar_rotation(F)  # expansion: the grains come apart, no strain is left
    elif flow > 0.0:
        result = exp_symmetric((-flow / size) * D) * F
    return result
