"""Forward simulation by the material point method with a given elastic material: PhysGaussian (Xie et al., CVPR 2024).

Every opaque kernel is a particle and deforms with it: S = F S_0 F^T. The material is not identified: Young's modulus
comes from the configuration. The original has no initial velocity of a recorded sequence; here a velocity field per
sequence is fitted to its first frames, or zero.
"""

from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.fitted import Recorded
from gausim.baselines.material_point.driven import Driven, opaque
from gausim.baselines.material_point.method import Discretisation, Domain, MaterialPoints, require_modulus
from gausim.baselines.mpm import Material
from gausim.core import GaussianScene

# Values of the original: the scene's longest side is 1, 50 cells over a domain of edge 2, 100 substeps per frame.
SIDE, SIZE, CELLS, SUBSTEPS = 1.0, 2.0, 50, 100
OPACITY = 0.02  # kernels of less opacity are no particles


class PhysGaussian(MaterialPoints):
    """All opaque simulated kernels as particles of a given material; transparent ones follow the nearest."""

    name = "physgaussian"

    def __init__(
        self,
        *,
        material: Material,
        discretisation: Discretisation,
        opacity: float = OPACITY,
        velocity_resolution: int = 24,
        velocity_scale: float = 0.18,
        **recorded: Unpack[Recorded],
    ) -> None:
        """Places the particles.

        Args:
            material: E, nu and rho [simulation units].
            discretisation: ``cells`` per axis of the domain, whose edge is twice the longest side.
            opacity: threshold above which a kernel is a particle.
            velocity_resolution: resolution of the planes of the velocity fields.
            velocity_scale: factor on the velocity fields' outputs [longest sides / s].

        Raises:
            ConfigError: a number out of range, or Warp is not installed.
            SceneError: no kernel is opaque enough.
        """
        self.opacity = opacity
        require_modulus(material.young_modulus)
        super().__init__(
            **recorded,
            material=material,
            domain=Domain(SIDE, SIZE, discretisation.cells, discretisation),
            velocity_resolution=velocity_resolution,
            velocity_scale=velocity_scale,
        )
        for scene_id in range(len(self.scenes)):
            moduli = torch.full((len(self.body(scene_id).driven.rest),), float(material.young_modulus))
            self.register_buffer(f"young_{scene_id}", moduli)

    def drive(self, scene: GaussianScene) -> Driven:
        """Every opaque kernel and every point that fills the interior."""
        return opaque(scene, self.opacity, self.interior(scene))

    def modulus(self, scene_id: int) -> Float[Tensor, " P"]:
        """Young's modulus of the particles [simulation units]."""
        return self.get_buffer(f"young_{scene_id}")

    def notes(self) -> tuple[str, ...]:
        """The note that the material is not identified, and differences from the original."""
        return (
            "PhysGaussian with a given modulus, which it does not identify; the original does not fit how a "
            f"sequence begins either, and takes {CELLS} cells (here {self.domain.cells}) and {SUBSTEPS} substeps.",
            *(f"{self.description(i)}." for i in range(len(self.scenes))),
        )
