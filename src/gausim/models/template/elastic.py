"""An elastic template: learned elastodynamics in the vibration modes of a solid body.

With u the displacement of the units and Phi the lowest mass-orthonormal modes of the body that the kernels bound,
z = Phi^T M u obeys z'' + D z' + K z = f(z), f being the nonlinear part of the force of springs between the units. A
frame is the step that all modal templates have in common (:class:`gausim.models.template.modal.ModalScene`), which
creates no energy whatever positive semi-definite K and D are. They are trained as products S L L^T S around the body's
spectrum, so that the modes may mix. Trained inertia allows masses that differ from the units' volumes: z above is
replaced by H z with a trained matrix H, hence inertia H^T H.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.models.template.modal import ModalScene, force_of_strain
from gausim.models.template.solid import SolidSettings, solid_body
from gausim.models.template.springs import unit_springs
from gausim.models.template.template import PreparedScenes, Property, Template

COARSE = SolidSettings(0.12, 0.0)
# Gains on the parameters: with one learning rate, logarithms of stiffness and damping change faster than the mixing of
# modes.
SPECTRUM_GAIN, MIXING_GAIN = 2.0, 0.3
# Logarithm of the initial damping [1 / frame], nearly undamped.
INITIAL_LOG_DAMPING = -4.0


class ElasticScene(nn.Module):
    """Modes of one scene and the trained matrices of their dynamics."""

    values: Tensor
    modes: Tensor
    projection: Tensor
    gradients: Tensor
    strains: Tensor

    def __init__(
        self,
        hierarchy: Hierarchy, finest: int, *,
        modes: int, neighbours: int, period: float, amplitude: float, geometric: float, solid: SolidSettings,
    ) -> None:  # fmt: skip
        """Initialises from ``period`` of the lowest mode [frames], ``amplitude`` [diagonals] and ``geometric``."""
        super().__init__()
        level = hierarchy.levels[finest]
        rest = level.rest.double().numpy()
        mass = level.volume.double().numpy()
        mass = mass / mass.mean()
        pinned = level.pinned.numpy()
        finer = hierarchy.levels[0]
        kernels, held = finer.rest.double().numpy(), finer.pinned.numpy()
        body = solid_body(
            kernels, held, rest, mass, pinned,
            modes=modes, spacing=solid.size(kernels, hierarchy.diagonal), inside=solid.held_inside,
        )  # fmt: skip
        values, phi, slopes, strains = body.of_units(rest, pinned)
        count = phi.shape[-1]
        self.register_buffer("values", torch.from_numpy(values).float())
        self.register_buffer("modes", torch.from_numpy(phi).float())
        self.register_buffer("projection", torch.from_numpy(phi * mass[:, None, None]).float())
        self.register_buffer("gradients", torch.from_numpy(slopes).float())
        self.register_buffer("strains", torch.from_numpy(strains).float(), persistent=False)
        self.scale = amplitude * hierarchy.diagonal * math.sqrt(len(rest) / count)
        self.initial_log_stiffness = 2 * math.log(2 * math.pi / period)
        self.stiffness = nn.Parameter(torch.zeros(()))
        self.spectrum = nn.Parameter(torch.zeros(count))
        self.mixing = nn.Parameter(torch.zeros(count, count))
        self.damping = nn.Parameter(torch.zeros(count))
        self.damping_mixing = nn.Parameter(torch.zeros(count, count))
        self.inertia_mixing = nn.Parameter(torch.zeros(count, count))
        # Of every unit: density, stiffness of shear and of volume [k], beyond those of a homogeneous body under a load.
        self.beyond = nn.Parameter(torch.zeros(len(rest), 3))
        self.springs = unit_springs(rest, phi, neighbours)
        self.gain = nn.Parameter(torch.tensor(float(geometric)))

    def roots(self) -> tuple[Tensor, Tensor]:
        """S (M,) and L (M, M) of K = S L L^T S."""
        log_stiffness = self.initial_log_stiffness + SPECTRUM_GAIN * (self.stiffness + self.spectrum)
        return (0.5 * log_stiffness).exp() * self.values.sqrt(), self._identity() + MIXING_GAIN * self.mixing

    def inertia_root(self) -> Tensor:
        """H (M, M) of the inertia H^T H."""
        return self._identity() + MIXING_GAIN * self.inertia_mixing

    def mixing_size(self) -> Float[Tensor, ""]:
        """Squared Frobenius norm of the mode mixing in stiffness, damping and inertia."""
        mixings = (self.mixing, self.damping_mixing, self.inertia_mixing)
        return torch.stack([(MIXING_GAIN * m).square().sum() for m in mixings]).sum()

    def _identity(self) -> Tensor:
        return torch.eye(len(self.values), dtype=self.values.dtype, device=self.values.device)

    def dissipation(self) -> Tensor:
        """D (M, M)."""
        log_damping = INITIAL_LOG_DAMPING + SPECTRUM_GAIN * self.damping
        factor = (0.5 * log_damping).exp()[:, None] * (self._identity() + MIXING_GAIN * self.damping_mixing)
        return factor @ factor.mT

    def resistance(self) -> Float[Tensor, " N"]:
        """Compliance of each unit under a force on it in the homogeneous body over that in the trained one.

        The compliance is tr(Phi_i K^-1 Phi_i^T). It depends on where a unit sits, the quotient does not. The mean of
        its logarithm over the free units is 0; pinned units have none (NaN).
        """
        root, mixing = self.roots()
        factor = (root[:, None] * mixing).mT @ self.inertia_root()  # the trained stiffness is its square
        trained = torch.linalg.solve(factor.mT, self.modes.flatten(0, 1).mT).square().sum(0)
        even = (self.modes.square() / self.values).sum((1, 2))
        quotient = even / trained.view(-1, 3).sum(1)
        return quotient / quotient.log().nanmean().exp()

    def damping_rate(self) -> Float[Tensor, " N"]:
        """Rate at which the motion after an impulse on each unit loses momentum to D [1 / frame]; NaN for pinned units.

        v = (H^T H)^-1 Phi_i^T; the rate is v^T H^T D H v over v^T H^T H v, summed over the directions.
        """
        pushed = torch.linalg.solve(self.inertia_root().mT, self.modes.flatten(0, 1).mT)  # H v (M, 3 N)
        lost = (pushed * (self.dissipation() @ pushed)).sum(0)
        return lost.view(-1, 3).sum(1) / pushed.square().sum(0).view(-1, 3).sum(1)


class PreparedElastic(ModalScene):
    """Matrices of a scene's step between two updates of the parameters."""

    def __init__(self, scene: ElasticScene) -> None:
        """Computes the constants; loss gradients flow through them."""
        super().__init__(scene.projection, scene.modes, scene.gradients)
        self.scene, self.nonlinear = scene, scene.springs
        self.factor = scene.gain * (scene.initial_log_stiffness + SPECTRUM_GAIN * scene.stiffness).exp()
        root, (stretch, mixing) = scene.inertia_root(), scene.roots()
        pull = (stretch[:, None] * mixing).mT @ root
        self.inertia, self.stiffness = root.mT @ root, pull.mT @ pull
        self.mass = self.inertia
        self.damping = root.mT @ scene.dissipation() @ root

    def force(self, load: Float[Tensor, "S N 12"]) -> Float[Tensor, "S M"]:
        """Phi^T M a of an acceleration a within the modes, and what density and stiffness add that are not even."""
        acceleration, strain = load.split((3, 9), -1)
        density, uneven = self.scene.beyond.split((1, 2), -1)
        scale = (self.scene.initial_log_stiffness + SPECTRUM_GAIN * self.scene.stiffness).exp()
        own = super().force(load) + (density * acceleration).flatten(1) @ self.projection
        return own + force_of_strain(strain, scale * uneven, self.scene.strains)


class ElasticTemplate(Template):
    """Template with learned elastodynamics, one set of matrices per scene."""

    has_energy = True

    def __init__(
        self,
        hierarchies: Sequence[Hierarchy],
        finest: int,
        *,
        modes: int = 48,
        neighbours: int = 24,
        period: float = 8.0,
        amplitude: float = 0.02,
        geometric: float = 1.0,
        solid: SolidSettings = COARSE,
        attributes: int = 0,
        frames: Sequence[np.ndarray] = (),
        conserve_volume: bool = True,
    ) -> None:
        """Builds the scenes; for the equations see the module's docstring.

        Args:
            hierarchies: one per scene.
            finest: level whose units the modes move.
            modes: number of vibration modes.
            neighbours: springs per unit.
            period: initial period of the lowest mode [frames].
            amplitude: typical displacement [diagonals], the size of initial velocities.
            geometric: initial factor on the springs' nonlinear force, trained.
            solid: the solid body.
            attributes: number of attributes per unit, unused: the material of a scene is in its matrices.
            frames: axes of the scenes, unused.
            conserve_volume: scale the template's deformation gradients to determinant 1 (METHOD's mass conservation).
        """
        super().__init__()
        self.conserve_volume = conserve_volume
        self.scenes = nn.ModuleList(
            ElasticScene(
                h, finest, modes=modes, neighbours=neighbours, period=period, amplitude=amplitude,
                geometric=geometric, solid=solid,
            )
            for h in hierarchies
        )  # fmt: skip

    def scene(self, scene_id: int) -> ElasticScene:
        """Modes and matrices of one scene."""
        return cast(ElasticScene, self.scenes[scene_id])

    def material(self, scene_id: int, units: FixedUnits, fps: float) -> dict[str, Property]:
        """What a scene's matrices tell about its units."""
        scene = self.scene(scene_id)
        return {
            **super().material(scene_id, units, fps),
            "stiffness": Property(scene.resistance(), "resistance to a force over that of a homogeneous body"),
            "damping": Property(fps * scene.damping_rate(), "damping of an impulse [1/s]"),
        }

    def mixing(self, scene_id: int) -> Float[Tensor, ""]:
        """Squared Frobenius norm of the mode mixing of a scene's matrices."""
        return self.scene(scene_id).mixing_size()

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """Prefix of all names of the scene's template."""
        return (f"{prefix}scenes.{scene_id}.",)

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedScenes:
        """Template with constant matrices: positions X + Phi z, deformation gradients I + grad(Phi) z."""
        return PreparedScenes(
            batch, lambda scene_id, _: PreparedElastic(self.scene(scene_id)), conserve_volume=self.conserve_volume
        )

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor]:
        """Modes (N, 3, M), displacement gradients (N, 3, 3, M) and sizes (M,), initially of equal energy."""
        scene = self.scene(scene_id)
        sizes = scene.values.rsqrt()
        return scene.modes * (scene.scale * sizes), scene.gradients * (scene.scale * sizes), sizes
