"""Which stress and which return map a kind of material has. The numbers are those of ``config.MaterialKind``."""

import warp as wp

from gausim.baselines.mpm.config import MaterialKind
from gausim.baselines.mpm.device_code.drucker_prager import drucker_prager
from gausim.baselines.mpm.device_code.elasticity import fixed_corotated, hencky_stress
from gausim.baselines.mpm.device_code.viscoplastic import viscoplastic
from gausim.baselines.mpm.device_code.von_mises import plastic_flow, von_mises

FIXED_COROTATED = wp.constant(int(MaterialKind.FIXED_COROTATED))
VON_MISES = wp.constant(int(MaterialKind.VON_MISES))
DRUCKER_PRAGER = wp.constant(int(MaterialKind.DRUCKER_PRAGER))
VISCOPLASTIC = wp.constant(int(MaterialKind.VISCOPLASTIC))
PLASTICINE = wp.constant(int(MaterialKind.PLASTICINE))


@wp.func
def kirchhoff_stress(kind: int, F: wp.mat33, mu: float, lam: float, yield_stress: float) -> wp.mat33:
    """Tau of the material; plasticine that has softened to nothing bears no stress."""
    tau = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if kind == FIXED_COROTATED:
        tau = fixed_corotated(F, mu, lam)
    elif kind == PLASTICINE:
        if yield_stress > 0.0:
            tau = fixed_corotated(F, mu, lam)
    else:
        tau = hencky_stress(F, mu, lam)
    return tau


@wp.func
def return_map(
    kind: int, F: wp.mat33, mu: float, lam: float, yield_stress: float, rheology: wp.vec3, dt: float
) -> wp.mat33:
    """The elastic part of the trial gradient; ``rheology`` = (friction, viscosity, softening)."""
    result = F
    if kind == VON_MISES or kind == PLASTICINE:
        result = von_mises(F, mu, yield_stress)
    elif kind == DRUCKER_PRAGER:
        result = drucker_prager(F, mu, lam, rheology[0])
    elif kind == VISCOPLASTIC:
        result = viscoplastic(F, mu, yield_stress, rheology[1], dt)
    return result


@wp.func
def softened(kind: int, F: wp.mat33, mu: float, yield_stress: float, rheology: wp.vec3) -> float:
    """Yield stress after the trial gradient F: y - softening * flow for plasticine, unchanged for the others."""
    result = yield_stress
    if kind == PLASTICINE:
        if yield_stress > 0.0:
            result = yield_stress - rheology[2] * plastic_flow(F, mu, yield_stress)
    return result
