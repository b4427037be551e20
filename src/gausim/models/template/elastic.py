"""An elastic template: learned linear elastodynamics in the vibration modes of the units' spring network.

With u the displacement of the units and Phi the lowest mass-orthonormal modes of a spring network over the rest graph,
z = Phi^T M u obeys z'' + D z' + K z = f(z, z'). One frame is one step of the trapezoidal rule in two-step form,

    (I + K/4 + D/2) z_{t+1} = (2 I - K/2) z_t - (I + K/4 - D/2) z_{t-1} + f(z_t, z_t - z_{t-1})     [frame units]

which for every positive semi-definite K and D is stable and creates no energy; with D = 0 it keeps it. K and D are
trained as S L L^T S products around the network's own spectrum, so that the modes may mix, and f is a small network
that is zero at rest and starts at zero. The mass may differ from the units' volume, too: with trained inertia z above
is G z, G a trained matrix, which makes the inertia G^T G and leaves every property as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.models.template.solid import solid_body
from gausim.models.template.springs import Springs, held_below, mode_gradients, unit_springs, vibration_modes
from gausim.models.template.template import PreparedScenes, Template, modal_coordinates
from gausim.nn.mlp import mlp, zero_output

# Logarithms of stiffness and damping may move ten times faster than the mixing of modes; written as gains on the
# parameters so that one learning rate serves both.
SPECTRUM_GAIN, MIXING_GAIN = 2.0, 0.3
# Nearly undamped at the start: exp(-4) per frame of the velocity.
INITIAL_LOG_DAMPING = -4.0
DAMPINGS = ("full", "modal", "rayleigh", "structural")
INERTIAS = ("volume", "trained")


class ElasticScene(nn.Module):
    """Modes of one scene and the trained matrices that move them."""

    values: Tensor
    modes: Tensor
    projection: Tensor
    gradients: Tensor

    def __init__(
        self,
        hierarchy: Hierarchy,
        finest: int,
        *,
        modes: int,
        neighbours: int,
        period: float,
        hidden: int,
        amplitude: float,
        damping: str,
        inertia: str,
        geometric: float | None,
        solid: float | None,
    ) -> None:
        """``period`` of the lowest mode [frames] and ``amplitude`` [diagonals] only set the start."""
        super().__init__()
        level = hierarchy.levels[finest]
        rest = level.rest.double().numpy()
        mass = level.volume.double().numpy()
        mass = mass / mass.mean()
        pinned = level.pinned.numpy()
        if solid is None:
            values, phi = vibration_modes(rest, mass, pinned, modes=modes, neighbours=neighbours)
            slopes = mode_gradients(rest, phi, neighbours)
        else:
            finer = hierarchy.levels[0]
            kernels, spacing = finer.rest.double().numpy(), solid * hierarchy.diagonal
            body = solid_body(kernels, finer.pinned.numpy(), rest, mass, pinned, modes=modes, spacing=spacing)
            values, phi, slopes = body.of_units(rest, pinned)
        count = phi.shape[-1]
        self.register_buffer("values", torch.from_numpy(values).float())
        self.register_buffer("modes", torch.from_numpy(phi).float())
        self.register_buffer("projection", torch.from_numpy(phi * mass[:, None, None]).float())
        self.register_buffer("gradients", torch.from_numpy(slopes).float())
        self.scale = amplitude * hierarchy.diagonal * math.sqrt(len(rest) / count)
        self.initial_log_stiffness = 2 * math.log(2 * math.pi / period)
        self.stiffness = nn.Parameter(torch.zeros(()))
        self.spectrum = nn.Parameter(torch.zeros(count))
        self.mixing = nn.Parameter(torch.zeros(count, count))
        numbers = {"full": count, "modal": count, "rayleigh": 2, "structural": 1}
        self.damping, self._damping = nn.Parameter(torch.zeros(numbers[damping])), damping
        self.damping_mixing = nn.Parameter(torch.zeros(count, count)) if damping == "full" else None
        self.inertia_mixing = nn.Parameter(torch.zeros(count, count)) if inertia == "trained" else None
        self.springs = None if geometric is None else unit_springs(rest, phi, neighbours)
        self.gain = None if geometric is None else nn.Parameter(torch.tensor(float(geometric)))
        self.force = mlp((2 * count, hidden, hidden, count)) if hidden else None
        if self.force is not None:
            zero_output(self.force)

    def roots(self) -> tuple[Tensor, Tensor]:
        """S (M,) and L (M, M) of K = S L L^T S."""
        log_stiffness = self.initial_log_stiffness + SPECTRUM_GAIN * (self.stiffness + self.spectrum)
        return (0.5 * log_stiffness).exp() * self.values.sqrt(), self._identity() + MIXING_GAIN * self.mixing

    def inertia_root(self) -> Tensor | None:
        """G (M, M) of the inertia G^T G; None where it is the identity."""
        return None if self.inertia_mixing is None else self._identity() + MIXING_GAIN * self.inertia_mixing

    def mixing_size(self) -> Float[Tensor, ""]:
        """Sum of the squares by which the mixings of modes in stiffness, damping and inertia differ from none."""
        mixings = (self.mixing, self.damping_mixing, self.inertia_mixing)
        return torch.stack([(MIXING_GAIN * m).square().sum() for m in mixings if m is not None]).sum()

    def _identity(self) -> Tensor:
        return torch.eye(len(self.values), dtype=self.values.dtype, device=self.values.device)

    def energy(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, " S"]:
        """|G v|^2 / 2 + (G m)^T K G m / 2 and the springs' beyond it, constants but for the displacements.

        v is the step and m the middle of both, as the trapezoidal rule has it: without damping and springs the
        template keeps this number exactly. G is the root of the inertia, the identity where it is not trained.
        """
        z, previous = modal_coordinates(now, before, self.projection.flatten(0, 1))
        root, mixing = (x.detach() for x in self.roots())
        step, middle = z - previous, (z + previous) / 2
        heavy = torch.stack((step, middle))
        if (inertia := self.inertia_root()) is not None:
            heavy = heavy @ inertia.detach().mT
        energy = 0.5 * (heavy[0].square().sum(-1) + ((heavy[1] * root) @ mixing).square().sum(-1))
        if self.springs is not None and self.gain is not None:
            size = self.gain.detach() * (self.initial_log_stiffness + SPECTRUM_GAIN * self.stiffness.detach()).exp()
            energy = energy + size * self.springs.potential(middle)
        return energy

    def dissipation(self) -> Tensor:
        """D (M, M)."""
        identity = self._identity()
        log_damping = INITIAL_LOG_DAMPING + SPECTRUM_GAIN * self.damping
        if self.damping_mixing is not None:
            factor = (0.5 * log_damping).exp()[:, None] * (identity + MIXING_GAIN * self.damping_mixing)
            return factor @ factor.mT
        if self._damping == "modal":
            return torch.diag(log_damping.exp())
        root, mixing = self.roots()
        if self._damping == "rayleigh":
            factor = root[:, None] * mixing
            return log_damping[0].exp() * identity + log_damping[1].exp() * (factor @ factor.mT)
        factor = root.sqrt()[:, None] * mixing
        return 2 * log_damping.exp() * factor @ factor.mT

    def matrices(self) -> tuple[Tensor, Tensor, Tensor]:
        """A, B and H of z_{t+1} = A z_t - B z_{t-1} + H f."""
        identity = self._identity()
        root, mixing = self.roots()
        factor = root[:, None] * mixing
        stiffness, damping = factor @ factor.mT, self.dissipation()
        inverse = torch.linalg.inv(identity + stiffness / 4 + damping / 2)
        now, before = inverse @ (2 * identity - stiffness / 2), inverse @ (identity + stiffness / 4 - damping / 2)
        if (inertia := self.inertia_root()) is None:
            return now, before, inverse
        back = torch.linalg.inv(inertia)
        return back @ now @ inertia, back @ before @ inertia, back @ inverse @ back.mT

    def forward(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, "S M"]:
        """Modal coordinates at t + 1 from the displacements at t and t - 1 of S sequences."""
        return PreparedElastic(self).coordinates(now, before)


class PreparedElastic:
    """An elastic scene while its parameters do not change: its matrices and what the force is at rest."""

    def __init__(self, scene: ElasticScene) -> None:
        """Computes the constants; gradients flow through them."""
        self.scene = scene
        a, b, h = scene.matrices()
        self.projection = scene.projection.flatten(0, 1)
        # Positions and gradients of a unit side by side: one product gives both.
        self.motions = torch.cat((scene.modes, scene.gradients.flatten(1, 2)), 1).flatten(0, 1)
        self.force, parts = scene.force, [a.mT, -b.mT]
        if scene.springs is not None and scene.gain is not None:
            size = (scene.initial_log_stiffness + SPECTRUM_GAIN * scene.stiffness).exp()
            self.turned = scene.gain * size * h.mT
            # I - A + B = H K: how the trained stiffness pulls back.
            self.pull = torch.eye(len(a), dtype=a.dtype, device=a.device) - a.mT + b.mT
        if self.force is not None:
            parts.append(0.1 * scene.scale * h.mT)
            self.still = self.force(a.new_zeros(1, 2 * len(scene.values)))
        self.transition = torch.cat(parts)

    def carried(self, displacement: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 3"]:
        """All of it: the network's corrections are small here."""
        return displacement

    def coordinates(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, "S M"]:
        """Modal coordinates at t + 1 from the displacements at t and t - 1 of S sequences."""
        z, previous = modal_coordinates(now, before, self.projection)
        parts = [z, previous]
        if self.force is not None:
            parts.append(self.force(torch.cat((z, z - previous), -1) / self.scene.scale) - self.still)
        after = torch.cat(parts, -1) @ self.transition
        return after if self.scene.springs is None else after + self._springs(self.scene.springs, z)

    def _springs(self, springs: Springs, z: Float[Tensor, "S M"]) -> Float[Tensor, "S M"]:
        """What the springs add to the next coordinates."""
        return held_below(springs(z) @ self.turned, z @ self.pull)

    def __call__(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 12"]:
        """Displacement and its gradient, row by row, of every unit at t + 1."""
        z = self.coordinates(now, before)
        return (z @ self.motions.mT).view(*now.shape[:2], 12)

    def energy(self, now: Float[Tensor, "S N 3"], before: Float[Tensor, "S N 3"]) -> Float[Tensor, " S"]:
        """Energy, see :meth:`ElasticScene.energy`."""
        return self.scene.energy(now, before)


class ElasticTemplate(Template):
    """Proposes the next state by learned elastodynamics, one set of matrices per scene."""

    has_energy = True

    def __init__(
        self,
        hierarchies: Sequence[Hierarchy],
        finest: int,
        *,
        modes: int = 48,
        neighbours: int = 24,
        period: float = 8.0,
        hidden: int = 64,
        amplitude: float = 0.02,
        damping: str = "full",
        inertia: str = "volume",
        geometric: float | None = None,
        solid: float | None = None,
        attributes: int = 0,
        frames: Sequence[np.ndarray] = (),
        conserve_volume: bool = True,
    ) -> None:
        """See the module's text.

        Args:
            hierarchies: one per scene.
            finest: level whose units carry the modes.
            modes: number of vibration modes kept.
            neighbours: springs per unit.
            period: initial period of the lowest mode [frames].
            hidden: width of the nonlinear force network, 0 for none.
            amplitude: typical displacement [diagonals], scales that network's inputs.
            damping: ``full``, a trained matrix; ``modal``, a number per mode; ``rayleigh``, a uniform and a part in
                proportion to K, two numbers; ``structural``, the same share of critical for all modes, one number.
            inertia: ``volume``, mass in proportion to the units' volume; ``trained``, a matrix that starts there.
            geometric: how much of the springs' nonlinear force there is at the start, trained; None leaves it out.
            solid: take the modes of the solid body around the kernels on a grid of this spacing [diagonals]; None takes
                those of the springs between units.
            attributes: of the units, not read here: what a scene is made of is in its matrices.
            frames: axes of the scenes, not read here.
            conserve_volume: scale the template's gradients to determinant 1 (METHOD's mass conservation).
        """
        super().__init__()
        if damping not in DAMPINGS:
            raise ConfigError(f"model.template.damping is '{damping}'; expected one of {', '.join(DAMPINGS)}.")
        if inertia not in INERTIAS:
            raise ConfigError(f"model.template.inertia is '{inertia}'; expected one of {', '.join(INERTIAS)}.")
        self.conserve_volume = conserve_volume
        self.scenes = nn.ModuleList(
            ElasticScene(
                h,
                finest,
                modes=modes,
                neighbours=neighbours,
                period=period,
                hidden=hidden,
                amplitude=amplitude,
                damping=damping,
                inertia=inertia,
                geometric=geometric,
                solid=solid,
            )
            for h in hierarchies
        )

    def scene(self, scene_id: int) -> ElasticScene:
        """Modes and matrices of one scene."""
        scene = self.scenes[scene_id]
        assert isinstance(scene, ElasticScene)
        return scene

    def mixing(self, scene_id: int) -> Float[Tensor, ""]:
        """How much the trained matrices mix the modes of the scene's body, a sum of squares."""
        return self.scene(scene_id).mixing_size()

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """Everything of the scene's template."""
        return (f"{prefix}scenes.{scene_id}.",)

    def networks(self) -> list[nn.Parameter]:
        """Weights of the nonlinear forces."""
        forces = (self.scene(i).force for i in range(len(self.scenes)))
        return [p for force in forces if force is not None for p in force.parameters()]

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedScenes:
        """The template with its matrices computed: positions X + Phi z and gradients I + grad(Phi) z."""
        return PreparedScenes(
            batch, lambda scene_id, _: PreparedElastic(self.scene(scene_id)), conserve_volume=self.conserve_volume
        )

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor]:
        """Modes (N, 3, M), their gradients (N, 3, 3, M) and sizes (M,): motions of equal energy at the start."""
        scene = self.scene(scene_id)
        sizes = scene.values.rsqrt()
        return scene.modes * (scene.scale * sizes), scene.gradients * (scene.scale * sizes), sizes
