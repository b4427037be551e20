"""The Kirchhoff stress tau = J sigma of the elastic energy."""

import warp as wp

from gausim.baselines.mpm.device_code.matrices import identity, polar_rotation


@wp.func
def shear_modulus(young: float, poisson: float) -> float:
    """The modulus mu = E / (2 (1 + nu))."""
    return young / (2.0 * (1.0 + poisson))


@wp.func
def lame_lambda(young: float, poisson: float) -> float:
    """Lambda = E nu / ((1 + nu) (1 - 2 nu))."""
    return young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


@wp.func
def fixed_corotated(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """Tau = 2 mu (F - R) F^T + lambda J (J - 1) I (Stomakhin et al. 2012)."""
    R = polar_rotation(F)
    J = wp.determinant(F)
    return 2.0 * mu * (F - R) * wp.transpose(F) + lam * J * (J - 1.0) * identity()
