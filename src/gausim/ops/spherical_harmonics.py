"""Real spherical harmonics of 3DGS files, degree 0 to 3."""

import torch
from jaxtyping import Float
from torch import Tensor

# Normalisation constants of the real basis, in the order and with the signs of the INRIA 3DGS format.
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def spherical_harmonics_basis(degree: int, directions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N B"]:
    """The (degree + 1)^2 basis functions at unit directions."""
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, C0)]
    if degree > 0:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        terms += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree > 2:
        terms += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, -1)


def evaluate_sh(sh: Float[Tensor, "*N B 3"], directions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Colour in a direction: max(0, 0.5 + sum_b sh_b Y_b(d)), as every 3DGS viewer shows it.

    ``directions`` are unit vectors from the camera to the kernel (for a rotated kernel: Q^T d, METHOD section 2).
    """
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[-2]]
    basis = spherical_harmonics_basis(degree, directions)
    return torch.clamp_min(torch.einsum("...b,...bc->...c", basis, sh) + 0.5, 0.0)
