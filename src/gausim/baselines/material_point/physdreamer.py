"""Young's modulus and velocities from video by a differentiable material point method: PhysDreamer (Zhang et al. 2024).

The original lets a video diffusion model dream the motion that it is fitted to; here calibrated videos take its place.
Fitted are a velocity field per sequence and a field of Young's modulus per object, which its sequences share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.material_point.driven import Driven, clustered
from gausim.baselines.material_point.fields import TriPlaneField
from gausim.baselines.material_point.method import (
    GREATEST_MODULUS,
    LEAST_MODULUS,
    Domain,
    MaterialPoints,
    require_modulus,
)
from gausim.baselines.mpm import Filling, Material
from gausim.baselines.mpm.config import COVERED_POISSON_RATIO, pressure_wave
from gausim.core import ConfigError, GaussianScene

# What the original takes: the scene's longest side is 1 / 1.8, cells of 1 / 64, 768 substeps per frame.
SIDE, CELLS, SUBSTEPS = 1 / 1.8, 64, 768
# Edge of the domain; the original's is 1, which large motions leave. Only nodes round the particles cost anything.
SIZE = 2.0
LOG, LINEAR = "log", "linear"


class PhysDreamer(MaterialPoints):
    """Driving particles by k-means, fixed corotated elasticity, and fields of velocity and Young's modulus.

    With the field's output f, E = clamp(E_0 exp(f)) or, the original's, clamp(E_0 + 1000 f).
    """

    name = "physdreamer (no diffusion prior)"

    def __init__(
        self,
        *,
        scenes: Sequence[GaussianScene],
        fps: Sequence[float],
        scene_of_sequence: Sequence[int],
        seen: int,
        particles: int = 600,
        cells: int = CELLS,
        young_modulus: float = 1e5,
        parametrisation: str = LOG,
        modulus_scale: float = 1.0,
        poisson_ratio: float = 0.3,
        density: float = 2000.0,
        damping: float = 0.0,
        substeps: int | None = None,
        most_substeps: int = SUBSTEPS,
        courant: float = 0.5,
        filling: Filling | None = None,
        gradients: bool = True,
        velocity_resolution: int = 24,
        velocity_scale: float = 0.18,
        modulus_resolution: int = 8,
    ) -> None:
        """Places the driving particles.

        Args:
            scenes: the rest scenes.
            fps: frames per second of each.
            scene_of_sequence: the scene of each sequence.
            seen: predicted frames that training may see.
            particles: at most so many per object.
            cells: per simulation unit; the longest side has ``cells`` / 1.8.
            young_modulus: E_0 [simulation units].
            parametrisation: ``log``, E_0 exp(s f), or ``linear``, E_0 + s f.
            modulus_scale: s.
            poisson_ratio: nu.
            density: rho [simulation units].
            damping: rate at which the grid loses velocity [1 / s].
            substeps: per frame; None derives them from the bound of the time step.
            most_substeps: E is kept below what would need more.
            courant: c of that bound; measured, 0.5 is stable up to nu = 0.4.
            filling: how the interior is filled before particles are placed; None leaves it empty.
            gradients: kernels follow the affine maps of their particles; else their mean displacement and Kabsch
                rotation (the original).
            velocity_resolution: of the planes of the velocity fields.
            velocity_scale: of their outputs [longest sides / s]; 0.18 is the original's 0.1 simulation units.
            modulus_resolution: of the planes of the modulus fields.

        Raises:
            ConfigError: a number out of range, an unknown parametrisation, or Warp is not installed.
            SceneError: too few kernels.
        """
        if particles < 8 or cells < 4 or modulus_resolution < 2 or not modulus_scale > 0:
            raise ConfigError(
                "model.method: expected particles >= 8, cells >= 4, modulus_resolution >= 2 and modulus_scale > 0, got "
                f"{particles}, {cells}, {modulus_resolution} and {modulus_scale}."
            )
        if parametrisation not in (LOG, LINEAR):
            raise ConfigError(f"model.method.parametrisation: expected log or linear, got '{parametrisation}'.")
        self.most, self.gradients, self.cells = particles, gradients, cells
        self.initial, self.parametrisation, self.modulus_scale = (
            require_modulus(young_modulus), parametrisation, modulus_scale,
        )  # fmt: skip
        material = Material(young_modulus=young_modulus, poisson_ratio=poisson_ratio, density=density)
        domain = Domain(SIDE, SIZE, round(SIZE * cells), damping, substeps, courant, filling)
        self.greatest = [self._bound(rate, substeps or most_substeps, material, domain) for rate in fps]
        if young_modulus > min(self.greatest):
            raise ConfigError(
                f"model.method.young_modulus: {young_modulus:g} would need more than {substeps or most_substeps} "
                f"substeps per frame on {cells} cells, which allow {min(self.greatest):.3g}. Raise most_substeps (or "
                "substeps), or lower cells."
            )
        super().__init__(
            scenes=scenes,
            fps=fps,
            scene_of_sequence=scene_of_sequence,
            seen=seen,
            material=material,
            domain=domain,
            velocity_resolution=velocity_resolution,
            velocity_scale=velocity_scale,
        )
        self.modulus_field = nn.ModuleList(TriPlaneField(modulus_resolution) for _ in self.scenes)

    @staticmethod
    def _bound(fps: float, substeps: int, material: Material, domain: Domain) -> float:
        """The greatest E that so many substeps per frame allow, a little less: (c dx substeps fps)^2 rho."""
        faster = max(1.0, pressure_wave(material.poisson_ratio) / pressure_wave(COVERED_POISSON_RATIO))
        speed = 0.999 * domain.courant * domain.grid.dx * substeps * fps / faster
        return min(GREATEST_MODULUS, speed**2 * material.density)

    def drive(self, scene: GaussianScene) -> Driven:
        """K-means of the simulated kernels and of filled points."""
        return clustered(scene, self.domain.filled(scene), self.most, even=not self.gradients)

    def modulus(self, scene_id: int) -> Float[Tensor, " P"]:
        """Young's modulus of the driving particles [simulation units]."""
        return self.modulus_at(scene_id, self.body(scene_id).places)

    def modulus_at(self, scene_id: int, places: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """The same anywhere.

        Args:
            scene_id: the object.
            places: as :meth:`MaterialPoints.places` gives them.
        """
        f = self.modulus_scale * self.modulus_field[scene_id](places)[:, 0]
        found = self.initial * torch.exp(f) if self.parametrisation == LOG else self.initial + f
        return found.clamp(LEAST_MODULUS, self.greatest[scene_id])

    def carry(self, driven: Driven, x: Tensor, gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Kernels that follow their particles."""
        return driven.carried(x, gradients) if self.gradients else driven.turned(x)

    def notes(self) -> tuple[str, ...]:
        """What differs from the original, and what was found."""
        smaller = f" on {self.cells} cells per unit instead of {CELLS}" if self.cells < CELLS else ""
        return (
            f"PhysDreamer without its diffusion prior: fitted to the calibrated videos{smaller}; the original takes "
            f"{SUBSTEPS} substeps per frame and has a particle for 10 to 25 kernels.",
            *(f"{self.said(i)}; it began with {self.initial:.3g}." for i in range(len(self.scenes))),
        )

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``velocity`` per sequence; ``modulus`` per object."""
        return {**super().parameter_groups(), "modulus": list(self.modulus_field.parameters())}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """``velocity_variation`` and ``modulus_variation``: of the planes of the fields."""
        field = self.modulus_field[self.scene_of_sequence[sequence_id]]
        assert isinstance(field, TriPlaneField)
        return {**super().penalties(sequence_id), "modulus_variation": field.planes.variation()}
