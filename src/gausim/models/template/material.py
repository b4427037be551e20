"""The template of the neural simulator: a solid body whose material a shared network decodes from units' attributes.

The geometry is computed once per scene: the lowest modes Phi of the solid body around the kernels
(:mod:`gausim.models.template.solid`) and the contributions of each unit i, and of each spring (i, j) of a net of
springs, to elastic energy and mass, as matrices between these modes. The material is learned: decoders common to all
scenes map each unit's attributes a_i (its density rho_i enters directly) to logarithms of factors,

    s_i, b_i, d_i = decode(a_i) + (a_i1, a_i1, a_i2)
    g_ij = decode(a_i, a_j, distance) + (a_i1 + a_j1) / 2

The first attribute is thus itself the logarithm of stiffness over that of a reference material, the second that of
damping. These factors give, in modal coordinates z,

    K = k (sum_i (e^{s_i} K_i + e^{b_i} B_i) + sum_ij e^{g_ij} S_ij)   stiffness: of shear, of volume, of springs
    M = sum_i rho_i M_i                                    inertia
    C = 2 sum_i t_i rho_i M_i                              drag, with t_i = tanh(c_0 e^{d_i} / 2)
    D = C + (tr C / (4 tr M) + c_1) K                      damping

A net is no solid, and no field of material in a solid says how it holds together. So of a net of springs the part of K
that is the cells', R R^T, becomes R (1 + 0.3 W) (1 + 0.3 W)^T R^T, and M becomes H^T M H, H = 1 + 0.3 W', with W and W'
trained for each scene. K stays above the linear part of the springs' forces, so that the potential energy is positive.

k, c_0, c_1 and the resistance to growth are trained numbers common to all scenes. In a step of the trapezoidal rule an
even drag c_0 reduces the amplitudes of all modes, the fastest included, by exp(-c_0 / 2): that is what the tanh and the
first part of the factor of K are for. With D = c_0 M, modes too fast for the frame rate would hardly be damped, and
strong drag would turn the velocity round instead of stopping it. What is nonlinear are either the cells of the units,
with e^{s_i} and e^{b_i} (law ``solid``, :mod:`gausim.models.template.finite_strain`; it has no springs), or the springs
of stiffness e^{g_ij} (law ``springs``, :mod:`gausim.models.template.springs`). Both resist the growth of strain, or of
length, besides, which no rotation of the body meets: without it, vibrations near the frame rate ring on. A frame is the
step that all modal templates have in common (:class:`gausim.models.template.modal.ModalScene`). Modal derivatives swing
up to a thousand times in a frame, where a step can neither follow nor damp them and they tremble on. What they do is to
follow other modes, and they still do with inertia max(0, K_mm / w^2 - M_mm) more, with which none swings faster than w,
twice in a frame. K, M and D are positive semi-definite for all decoded values, so that a step never creates energy, and
without damping it conserves energy. It does not amplify vibrations too fast for the frame rate. The decoders' only
geometric input are distances, so that they generalise to other bodies and orientations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.clusters import Hierarchy
from gausim.models.hierarchy.units import FixedUnits
from gausim.models.template.body_modes import BodyModes
from gausim.models.template.modal import ModalScene, force_of_strain
from gausim.models.template.solid import SolidSettings
from gausim.models.template.template import DENSITY, PreparedScenes, Property, Template
from gausim.nn.mlp import mlp

# Bound of what the decoders add to the logarithms: factors between 1/12 and 12.
LARGEST_LOG = 2.5
# Largest angular frequency of a mode of a body with finite strain: two swings a frame [1 / frame].
FASTEST = 4 * math.pi
# Gains of k, of the dampings and of the resistance to growth over the decoders' weights, for one learning rate. That of
# damping is smaller: as long as a body's periods are wrong, strong damping fits best, and training is slow to reduce it
# again.
GAIN, DAMPING_GAIN, GROWTH_GAIN = 10.0, 0.5, 2.0
# Gain of W and W', and part of the mean stiffness that is added for its Cholesky factor.
MIXING_GAIN, LEAST_STIFF = 0.3, 1e-6
# Frame rate at which k and the dampings are defined [frames / s].
REFERENCE_FPS = 24.0


DEFAULT_SOLID = SolidSettings()


@dataclass(frozen=True)
class Links:
    """What neighbouring units do to each other."""

    neighbours: int = 24  # of a unit, to which springs lead in the law ``springs``
    damping: float = 0.03  # initial resistance to growth of length or strain over that to it [frames at 24 per second]


@dataclass(frozen=True)
class Damping:
    """Damping of solid bodies at the beginning; that of nets of springs is not trained."""

    drag: float = 0.0015  # c_0 [1 / frame]; 0: none, whatever is trained; a net of springs has none
    viscosity: float = 0.0015  # c_1 [frames]


@dataclass(frozen=True, eq=False)
class Matrices:
    """Matrices of the dynamics of one scene [frame units]."""

    stiffness: Float[Tensor, "M M"]  # K (M, M)
    mass: Float[Tensor, "M M"]  # M (M, M)
    inertia: Float[Tensor, "M M"]  # M, and with finite strain what slows the fastest modes (M, M)
    damping: Float[Tensor, "M M"]  # D (M, M)
    units: Float[Tensor, "N 2"]  # k e^{s_i} and k e^{b_i} of every unit (N, 2)
    springs: Float[Tensor, " E"]  # k e^{g_ij} of every spring, in units of S_ij (E,); none in the law ``solid``
    density: Float[Tensor, " N"]  # of every unit over that at the beginning
    uneven: Float[Tensor, "N 2"]  # k (e^{s_i} - 1) and k (e^{b_i} - 1), stiffness beyond that of the homogeneous body
    tense: Float[Tensor, " E"]  # the same of every spring, in units of S_ij
    growth: Tensor  # resistance to the growth of length or strain over that to it [frames]
    viscosity: Tensor  # the part of K in D [frames]
    rate: Tensor  # the part of inertia beyond the mass in D [1 / frame]


class MaterialTemplate(Template):
    """Template with the dynamics of a solid body, its material decoded from densities and attributes."""

    has_energy = True
    # The network contributes to the motion, so the template's energy of the first frame underestimates its peaks.
    headroom = 2.0

    def __init__(
        self,
        hierarchies: Sequence[Hierarchy],
        finest: int,
        *,
        attributes: int,
        frames: Sequence[np.ndarray],
        modes: int = 48,
        solid: SolidSettings = DEFAULT_SOLID,
        links: Links = Links(),
        hidden: int = 48,
        period: float = 8.0,
        damping: Damping = Damping(),
        conserve_volume: bool = True,
    ) -> None:
        """Builds the scenes and the decoders; for the equations see the module's docstring.

        Args:
            hierarchies: one per scene.
            finest: level whose units the modes move.
            attributes: number of attributes per unit.
            frames: axes (3, 3) of each scene in which the template works.
            modes: number of modes.
            solid: the solid body.
            links: links between units.
            hidden: width of the decoders.
            period: initial period of the lowest mode of a homogeneous body [frames at 24 per second].
            damping: initial c_0 and c_1.
            conserve_volume: scale the template's deformation gradients to determinant 1 (METHOD's mass conservation).

        Raises:
            ConfigError: fewer than two attributes, or a damping that is negative.
        """
        super().__init__()
        if attributes < 2:
            raise ConfigError(
                f"model.simulator.features.attributes: {attributes}; expected at least 2, stiffness and damping."
            )
        self.conserve_volume = conserve_volume
        self.links, self.solid, self.laws = links, solid, [h.law for h in hierarchies]
        body_modes = partial(BodyModes, finest=finest, solid=self.solid, links=self.links.neighbours)
        self.is_pinned = [bool(h.levels[0].pinned.any()) for h in hierarchies]
        counts = [modes * (1 if pinned else self.solid.free_modes) for pinned in self.is_pinned]
        self.bodies = nn.ModuleList(
            body_modes(h, frame=f, modes=count, finite=h.law == "solid")
            for h, f, count in zip(hierarchies, frames, counts, strict=True)
        )
        if damping.drag < 0 or damping.viscosity <= 0:
            raise ConfigError(f"model.simulator.template.damping: {damping}; expected drag >= 0 and viscosity > 0.")
        self.log_k = 2 * math.log(2 * math.pi / period)
        self.initial = damping
        logs = [math.log(damping.drag) if damping.drag else -math.inf, math.log(damping.viscosity)]
        self.register_buffer("log_damping", torch.tensor(logs), persistent=False)
        self.viscosity_scale: dict[int, float] = {}  # factors on c_1 of scenes, not saved with the model
        self.stiffness = nn.Parameter(torch.zeros(()))
        self.damping = nn.Parameter(torch.zeros(2))
        self.growth = nn.Parameter(torch.zeros(()))
        nets = {str(i): len(self.body(i).values) for i, law in enumerate(self.laws) if law == "springs"}
        self.nets = nn.ParameterDict({i: torch.zeros(2, count, count) for i, count in nets.items()})
        self.unit_decoder = mlp((attributes, hidden, 3))
        self.link_decoder = mlp((3 * attributes + 1, hidden, 1))

    def has_drag(self, scene_id: int) -> bool:
        """Whether a scene has drag, which the second attribute changes."""
        return self.initial.drag > 0 and self.laws[scene_id] == "solid"

    @property
    def log_drag(self) -> float:
        """Logarithm of c_0 at the beginning, to which the second attribute is relative [1 / frame].

        Raises:
            ConfigError: there is no drag.
        """
        if not self.initial.drag:
            raise ConfigError("model.simulator.template.damping.drag is 0: no attribute can set the damping of a body.")
        return math.log(self.initial.drag)

    def body(self, scene_id: int) -> BodyModes:
        """Modes of one scene."""
        return cast(BodyModes, self.bodies[scene_id])

    def decode(
        self, body: BodyModes, attributes: Float[Tensor, "N A"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " E"]]:
        """s, b and d of every unit; g of every spring (see the module's docstring).

        The decoded values at zero attributes are subtracted from those of units, so that zero attributes give zero.
        What the decoders give is bounded; the first two attributes are not, so that one material may be many times as
        stiff as another.
        """
        units = self.unit_decoder(attributes) - self.unit_decoder(torch.zeros_like(attributes[:1]))
        stiffness, damping = attributes[:, 0], attributes[:, 1]
        own = torch.stack((stiffness, stiffness, damping), -1) + _saturated(units)
        if body.springs is None:
            return own, attributes.new_zeros(0)
        a, b = (attributes.index_select(0, end) for end in body.springs.ends)
        springs = self.link_decoder(torch.cat((a + b, (a - b).square(), a * b, body.distance[:, None]), -1))
        return own, (a + b)[:, 0] / 2 + _saturated(springs[:, 0])

    def _damping(self, scene_id: int) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
        """c_0, c_1 and the resistance to growth of a scene [1 / frame, frames, frames].

        A net of springs has no drag, and the others as given: a fit would take its errors of phase for damping, since a
        motion out of step is nearest when it is small. A free body has the resistance as given: until it lands it
        hardly strains, and its first frames would train the resistance on noise.
        """
        drag, viscosity = (cast(Tensor, self.log_damping) + DAMPING_GAIN * self.damping).exp()
        growth = self.links.damping * (GROWTH_GAIN * self.growth).exp()
        if self.laws[scene_id] != "solid":
            drag, viscosity = torch.zeros_like(drag), cast(Tensor, self.log_damping)[1].exp()
        if self.laws[scene_id] != "solid" or not self.is_pinned[scene_id]:
            growth = torch.full_like(growth, self.links.damping)
        return drag, viscosity * self.viscosity_scale.get(scene_id, 1.0), growth

    def matrices(
        self, scene_id: int, log_density: Float[Tensor, " N"], attributes: Float[Tensor, "N A"], dt: float | Tensor
    ) -> Matrices:
        """K, M and D of one scene from the densities and attributes of its units; ``dt`` is the frame interval [s]."""
        body, frame = self.body(scene_id), dt * REFERENCE_FPS
        units, springs = (logarithms.exp() for logarithms in self.decode(body, attributes))
        k = (self.log_k + GAIN * self.stiffness).exp() * frame**2
        drag, viscosity, growth = self._damping(scene_id)
        cells = units[:, :2]
        stiffness = torch.einsum("np,pnlm->lm", cells, body.stiffness)
        density = _saturated(log_density).exp()
        mass, dragged = _inertia(body, density, (drag * frame * units[:, 2]).div(2).tanh())
        if str(scene_id) in self.nets:
            stiffness, mass = self._of_net(scene_id, stiffness, mass)
        stiffness = k * (stiffness + body.stretch.mT @ (springs[:, None] * body.stretch))
        rate = _trace(dragged) / _trace(mass)
        viscous = rate / 4 + viscosity / frame
        inertia, damping = mass, dragged + viscous * stiffness
        if body.cells is not None:
            slowed = (stiffness.diagonal() / FASTEST**2 - mass.diagonal()).clamp_min(0).diag()
            inertia, damping = mass + slowed, damping + rate * slowed
        return Matrices(
            stiffness, mass, inertia, damping, k * cells, k * springs, density, k * (cells - 1), k * (springs - 1),
            growth / frame, viscous, rate,
        )  # fmt: skip

    def _of_net(
        self, scene_id: int, cells: Float[Tensor, "M M"], mass: Float[Tensor, "M M"]
    ) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M M"]]:
        """The cells' part of K and M of a net of springs from those of a solid."""
        one = torch.eye(len(mass), dtype=mass.dtype, device=mass.device)
        between, moved = one + MIXING_GAIN * self.nets[str(scene_id)]
        root = torch.linalg.cholesky_ex(cells + LEAST_STIFF * _trace(cells) / len(one) * one)[0] @ between
        return root @ root.mT, moved.mT @ mass @ moved

    def material(self, scene_id: int, units: FixedUnits, fps: float) -> dict[str, Property]:
        """Stiffness, density and, where there is drag, damping of the units as they enter K, M and D.

        Stiffness is the unit's part of the trace of K (half of each of its springs) over that of the homogeneous body
        that k stands for; damping is the drag c_0 e^{d_i}.
        """
        body = self.body(scene_id)
        decoded, springs = self.decode(body, units.attributes)
        parts = body.stiffness.diagonal(dim1=-2, dim2=-1).sum(-1)  # of shear and volume (2, N)
        own, homogeneous = (parts.mT * decoded[:, :2].exp()).sum(-1), parts.sum(0)
        size = 0.5 * body.stretch.square().sum(-1)
        for end in () if body.springs is None else body.springs.ends:
            own = own.index_add(0, end, springs.exp() * size)
            homogeneous = homogeneous.index_add(0, end, size)
        properties = {
            "stiffness": Property(own / homogeneous, "stiffness over that of a homogeneous body"),
            "density": Property(_saturated(units.log_density).exp(), DENSITY),
        }
        if self.has_drag(scene_id):
            drag = REFERENCE_FPS * self._damping(scene_id)[0] * decoded[:, 2].exp()
            properties["damping"] = Property(drag, "drag over momentum [1/s]")
        return properties

    @torch.no_grad()
    def slowest_period(
        self, scene_id: int, log_density: Float[Tensor, " N"], attributes: Float[Tensor, "N A"]
    ) -> float:
        """Period of the slowest mode of a scene of undamped small motions [s], from its units' material."""
        matrices = self.matrices(scene_id, log_density, attributes, 1 / REFERENCE_FPS)
        root = torch.linalg.inv(torch.linalg.cholesky(matrices.inertia))
        squared = torch.linalg.eigvalsh(root @ matrices.stiffness @ root.mT)[0]
        return 2 * math.pi / math.sqrt(float(squared)) / REFERENCE_FPS

    def shared(self, prefix: str) -> tuple[str, ...]:
        """Prefixes of the names of the decoders, of k, of the dampings and of the resistance to growth."""
        return tuple(prefix + name for name in ("stiffness", "damping", "growth", "unit_decoder.", "link_decoder."))

    def own(self, scene_id: int, prefix: str) -> tuple[str, ...]:
        """The name of W and W' of a net of springs; a solid has none."""
        return (f"{prefix}nets.{scene_id}",)

    def prepare(self, batch: SceneBatch, units: FixedUnits) -> PreparedScenes:
        """Template of a batch with constant matrices."""

        def prepared(scene_id: int, rows: Tensor) -> PreparedMaterial:
            density, attributes = (x.index_select(0, rows) for x in (units.log_density, units.attributes))
            matrices = self.matrices(scene_id, density, attributes, batch.levels[-1].dt.index_select(0, rows[:1])[0, 0])
            return PreparedMaterial(self.body(scene_id), matrices, math.exp(self.log_k))

        return PreparedScenes(batch, prepared, conserve_volume=self.conserve_volume)

    def basis(self, scene_id: int) -> tuple[Tensor, Tensor, Tensor]:
        """Modes (N, 3, M), displacement gradients (N, 3, 3, M) and sizes (M,): the basis of initial velocities."""
        body = self.body(scene_id)
        sizes = body.values**-0.25
        return body.modes * (body.scale * sizes), body.gradients * (body.scale * sizes), sizes


def _inertia(
    body: BodyModes, density: Float[Tensor, " N"], lost: Float[Tensor, " N"]
) -> tuple[Float[Tensor, "M M"], Float[Tensor, "M M"]]:
    """M and C from the densities of units and from t_i, the share of momentum that each loses."""
    heavy, root = density[:, None, None] * body.inertia, body.inertia.flatten(0, 1)
    return root.mT @ heavy.flatten(0, 1), 2 * root.mT @ (lost[:, None, None] * heavy).flatten(0, 1)


def _trace(matrix: Float[Tensor, "M M"]) -> Float[Tensor, ""]:
    """The trace. The backward pass of torch's own waits for the device, which a CUDA graph cannot."""
    return matrix.diagonal().sum()


def _saturated(logarithms: Tensor) -> Tensor:
    return LARGEST_LOG * torch.tanh(logarithms / LARGEST_LOG)


class PreparedMaterial(ModalScene):
    """Matrices of a scene's step between two updates of the parameters."""

    def __init__(self, body: BodyModes, matrices: Matrices, reference: float) -> None:
        """Computes the constants; loss gradients flow through them.

        ``reference`` is k at the start [1 / frame^2], to which corrections are relative.
        """
        super().__init__(body.projection, body.modes, body.gradients)
        self.matrices, self.positions = matrices, body.modes.flatten(0, 1)
        self.body, self.values, self.reference = body, body.values, reference
        self.mass, self.inertia = matrices.mass, matrices.inertia
        self.stiffness, self.damping = matrices.stiffness, matrices.damping
        self.growth = matrices.growth
        if body.springs is not None:
            self.nonlinear, self.factor = body.springs, matrices.springs
        if body.cells is not None:
            self.nonlinear, self.factor, self.corrections = body.cells, matrices.units, 4

    def force(self, load: Float[Tensor, "S N 12"]) -> Float[Tensor, "S M"]:
        """Phi^T M a of an acceleration a of every unit: sum_i rho_i m_i Phi_i^T a_i.

        And that of the strain of the reference, which is static for a homogeneous body: of the stiffness beyond it.
        """
        acceleration, strain = load.split((3, 9), -1)
        if self.body.springs is None:
            own = (self.matrices.density[:, None] * acceleration).flatten(1) @ self.projection
        else:
            own = super().force(load) + self.body.springs.pull(strain, self.matrices.tense)
        return own + force_of_strain(strain, self.matrices.uneven, self.body.strain)

    def correction_unit(self) -> Float[Tensor, ""]:
        """Ratio of the body's stiffness over inertia [1 / frame^2] to the reference's at 24 frames per second.

        A network that corrects accelerations then needs to know neither frame rate nor stiffness. For stiff bodies it
        is reduced as the trapezoidal rule reduces their pull.
        """
        reference = self.reference * self.values.sum()
        pace = _trace(self.matrices.stiffness) / _trace(self.mass) * len(self.values) / reference
        return pace * (1 + self.reference / 4) / (1 + pace * self.reference / 4)

    def carried(self, displacement: Float[Tensor, "S N 3"]) -> Float[Tensor, "S N 3"]:
        """The projection of a displacement onto the modes.

        It reduces a state to 2 M numbers. The network's displacements outside the modes appear in the predicted frame
        but not in the input of the next step; fed back, they could grow without a change of the template's energy.
        """
        z = displacement.flatten(1) @ self.projection
        return (z @ self.positions.mT).view_as(displacement)
