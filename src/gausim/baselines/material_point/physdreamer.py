"""Young's modulus and velocities from video by a differentiable material point method: PhysDreamer (Zhang et al. 2024).

The original is fitted to videos that a diffusion model generates; here it is fitted to the calibrated videos. The
fitted parameters are a velocity field per sequence and a field of Young's modulus per object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Unpack, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.fitted import Recorded
from gausim.baselines.material_point.driven import Driven, clustered
from gausim.baselines.material_point.method import (
    GREATEST_MODULUS,
    LEAST_MODULUS,
    Discretisation,
    Domain,
    MaterialPoints,
    TriPlaneField,
    require_modulus,
)
from gausim.baselines.mpm import Material
from gausim.baselines.mpm.config import COVERED_POISSON_RATIO, pressure_wave
from gausim.core import ConfigError, GaussianScene

# Values of the original: the scene's longest side is 1 / 1.8, cells of 1 / 64, 768 substeps per frame.
SIDE, CELLS, SUBSTEPS = 1 / 1.8, 64, 768
# Edge of the domain; the original's is 1, which large motions leave. Only nodes near the particles cost time.
SIZE = 2.0


@dataclass(frozen=True)
class ModulusField:
    """Young's modulus over an object: E_0 exp(s f); the original's is E_0 + 1000 f.

    Attributes:
        scale: s.
        resolution: resolution of the planes of f.
    """

    scale: float = 1.0
    resolution: int = 8

    def __post_init__(self) -> None:
        if self.resolution < 2 or not self.scale > 0:
            raise ConfigError(
                f"model.method.modulus: expected resolution >= 2 and scale > 0, got {self.resolution} and {self.scale}."
            )


class PhysDreamer(MaterialPoints):
    """Driving particles by k-means, fixed corotated elasticity, and fields of velocity and Young's modulus.

    Kernels follow the affine maps of their particles; in the original they turn, but keep their shape.
    """

    name = "physdreamer (no diffusion prior)"

    def __init__(
        self,
        *,
        particles: int,
        material: Material,
        discretisation: Discretisation,
        most_substeps: int = SUBSTEPS,
        modulus: ModulusField,
        velocity_resolution: int = 24,
        velocity_scale: float = 0.18,
        **recorded: Unpack[Recorded],
    ) -> None:
        """Places the driving particles.

        Args:
            particles: maximum number per object.
            material: E_0, nu and rho [simulation units].
            discretisation: ``cells`` per simulation unit; the longest side has ``cells`` / 1.8.
            most_substeps: E stays below values that need more substeps.
            modulus: the field of E.
            velocity_resolution: resolution of the planes of the velocity fields.
            velocity_scale: factor on their outputs [longest sides / s]; 0.18 is the original's 0.1 simulation units.

        Raises:
            ConfigError: a number out of range, or Warp is not installed.
            SceneError: too few kernels.
        """
        cells = discretisation.cells
        if particles < 8 or cells < 4:
            raise ConfigError(f"model.method: expected particles >= 8 and cells >= 4, got {particles} and {cells}.")
        self.most, self.cells, self.field = particles, cells, modulus
        self.initial = require_modulus(material.young_modulus)
        domain = Domain(SIDE, SIZE, round(SIZE * cells), discretisation)
        self.greatest = [self._bound(rate, most_substeps, material, domain) for rate in recorded["fps"]]
        if self.initial > min(self.greatest):
            raise ConfigError(
                f"model.method.material.young_modulus: {self.initial:g} would need more than {most_substeps} "
                f"substeps per frame on {cells} cells, which allow {min(self.greatest):.3g}. Raise most_substeps "
                "or lower discretisation.cells."
            )
        super().__init__(
            **recorded,
            material=material,
            domain=domain,
            velocity_resolution=velocity_resolution,
            velocity_scale=velocity_scale,
        )
        self.modulus_field = nn.ModuleList(TriPlaneField(modulus.resolution) for _ in self.scenes)

    @staticmethod
    def _bound(fps: float, substeps: int, material: Material, domain: Domain) -> float:
        """The largest E for this number of substeps per frame, with a small margin: (c dx substeps fps)^2 rho."""
        faster = max(1.0, pressure_wave(material.poisson_ratio) / pressure_wave(COVERED_POISSON_RATIO))
        speed = 0.999 * domain.settings.courant * domain.grid.dx * substeps * fps / faster
        return min(GREATEST_MODULUS, speed**2 * material.density)

    def drive(self, scene: GaussianScene) -> Driven:
        """K-means of the simulated kernels and of the points that fill the interior."""
        return clustered(scene, self.most, self.interior(scene))

    def modulus(self, scene_id: int) -> Float[Tensor, " P"]:
        """Young's modulus of the driving particles [simulation units]."""
        f = self.field.scale * self.modulus_field[scene_id](self.body(scene_id).places)[:, 0]
        return (self.initial * torch.exp(f)).clamp(LEAST_MODULUS, self.greatest[scene_id])

    def notes(self) -> tuple[str, ...]:
        """Differences from the original, and the fitted moduli."""
        smaller = f" on {self.cells} cells per unit instead of {CELLS}" if self.cells < CELLS else ""
        return (
            f"PhysDreamer without its diffusion prior: fitted to the calibrated videos{smaller}; the original takes "
            f"{SUBSTEPS} substeps per frame and has a particle for 10 to 25 kernels.",
            *(f"{self.description(i)}; it began with {self.initial:.3g}." for i in range(len(self.scenes))),
        )

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``velocity`` per sequence; ``modulus`` per object."""
        return {**super().parameter_groups(), "modulus": list(self.modulus_field.parameters())}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """``velocity_variation`` and ``modulus_variation``: of the planes of the fields."""
        field = self.modulus_field[self.scene_of_sequence[sequence_id]]
        return {**super().penalties(sequence_id), "modulus_variation": cast(TriPlaneField, field).planes.variation()}
