"""Base of the methods that move scenes by the material point method, with fitted velocities and perhaps moduli.

Units. A scene is scaled to ``side`` simulation units along its longest side, frames last 1 / fps seconds, and Young's
modulus E and density rho are in simulation units. The motion depends only on sqrt(E / rho) / side, the speed of
waves in sides per second: periods scale with side sqrt(rho / E), and a factor common to E and rho has no effect. So E
in PhysDreamer (side 1 / 1.8, rho 2000) corresponds to 0.324 E in PhysGaussian (side 1, rho 200).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Unpack, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import Parameter

from gausim.baselines.fitted import Fitted, FittedState, Recorded, moved
from gausim.baselines.material_point.driven import Driven
from gausim.baselines.mpm import (
    Filling,
    Grid,
    Material,
    MPMSolver,
    Particles,
    ParticleState,
    Slope,
    TimeStep,
    fill_interior,
)
from gausim.baselines.mpm.substeps import warp
from gausim.core import ConfigError, GaussianScene
from gausim.nn.mlp import mlp, zero_output
from gausim.nn.planes import SUM, Planes
from gausim.ops.covariance import covariance_from_scales

# Coulomb's coefficient of a floor that states none.
FRICTION = 0.5
# Range of Young's modulus in PhysDreamer [simulation units].
LEAST_MODULUS, GREATEST_MODULUS = 1e3, 5e8


class TriPlaneField(nn.Module):
    """A smooth function of space: summed features of three planes, a hidden layer, ``outputs`` numbers, 0 at first."""

    def __init__(self, resolution: int, *, features: int = 32, hidden: int = 32, outputs: int = 1) -> None:
        super().__init__()
        # The features, ``resolution`` numbers along both axes of each.
        self.planes = Planes([resolution] * 3, features, combine=SUM)
        self.network = mlp([features, hidden, outputs], "relu")  # maps the features to the outputs
        zero_output(self.network)

    def forward(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P outputs"]:
        """Values at points in [-1, 1]^3."""
        found: Tensor = self.network(self.planes(points))
        return found


@dataclass(frozen=True)
class SceneMapping:
    """x_sim = scale x + offset: deformation gradients and rotations are the same in both."""

    scale: float  # simulation units per scene unit
    offset: tuple[float, float, float]  # position of the scene's origin [simulation units]

    def to_simulation(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the simulation."""
        return self.scale * points + points.new_tensor(self.offset)

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Positions in the scene."""
        return (points - points.new_tensor(self.offset)) / self.scale


@dataclass(frozen=True)
class Discretisation:
    """Options of the grid, the time step and the filling.

    Attributes:
        cells: per axis of the method's unit of length.
        courant: c of the bound, dt < c dx / sqrt(E / rho); measured, 0.5 is stable up to nu = 0.4.
        filling: thresholds by which the interior gets particles; None leaves it empty.
    """

    cells: int
    courant: float = 0.5
    filling: Filling | None = None


@dataclass(frozen=True)
class Domain:
    """The cubic domain in which scenes are simulated."""

    side: float  # longest side of the scene in the simulation [simulation units]
    size: float  # edge of the cubic domain, in whose middle the scene is [simulation units]
    cells: int  # cells per axis over the whole domain
    settings: Discretisation  # time step and filling of the interior

    @property
    def grid(self) -> Grid:
        """The background grid."""
        return Grid(cells=self.cells, size=self.size)

    def grid_of(self, scene: GaussianScene) -> Grid:
        """The background grid with a scene's gravity and floor."""
        mapping, around = self.mapping(scene), scene.surroundings
        x, y, z = around.gravity or (0.0, 0.0, 0.0)
        slope, floor = None, around.floor
        if floor is not None:
            point = mapping.to_simulation(torch.tensor(floor.point, dtype=torch.float64))
            level = float(point @ torch.tensor(floor.normal, dtype=torch.float64))
            slope = Slope(floor.normal, level, FRICTION if floor.friction is None else floor.friction)
        pull = (mapping.scale * x, mapping.scale * y, mapping.scale * z)
        return replace(self.grid, gravity=pull, slope=slope)

    def mapping(self, scene: GaussianScene) -> SceneMapping:
        """The mapping from a scene to the simulation."""
        low, high = extent(scene)
        scale = self.side / float((high - low).amax())
        x, y, z = (self.size / 2 - scale * (low + high) / 2).tolist()
        return SceneMapping(scale, (x, y, z))


def extent(scene: GaussianScene) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Lower and upper corner of the bounding box of the simulated kernels [scene units]."""
    x = scene.means[scene.simulated].double()
    return x.amin(0), x.amax(0)


@dataclass(frozen=True, eq=False)
class Body:
    """One scene ready to be simulated on one device."""

    driven: Driven  # particles and kernels [scene units]
    mapping: SceneMapping  # mapping to the simulation
    # coordinates of the particles in the fields, in [-1, 1]^3; the longest side of the scene has length 2
    places: Float[Tensor, "P 3"]
    solver: MPMSolver  # solver that moves the particles


class MaterialPoints(Fitted):
    """Base of the methods with a velocity field per sequence, which the material point method carries on.

    Gravity acts on the grid, and its nodes slide on the floor. A free body begins at a fitted place.

    A velocity is ``velocity_scale`` times the field's output [longest sides / s], and 0 for pinned particles. Before
    fitting all velocities are 0.
    """

    # Particles keep their pins in place, and gravity is not identified.
    unknown = frozenset({"hands", "trained_gravity"})

    def __init__(
        self,
        *,
        material: Material,
        domain: Domain,
        velocity_resolution: int,
        velocity_scale: float,
        **recorded: Unpack[Recorded],
    ) -> None:
        """Places the particles.

        Args:
            material: material of all particles; :meth:`modulus` overrides its E.
            domain: domain of the simulation.
            velocity_resolution: resolution of the planes of the velocity fields.
            velocity_scale: factor on the velocity fields' outputs [longest sides / s].

        Raises:
            ConfigError: Warp is not installed, a number is out of range, or a scene has unknown surroundings.
            SceneError: too few kernels.
        """
        super().__init__(**recorded)
        if velocity_resolution < 2 or not velocity_scale > 0:
            raise ConfigError(
                "model.method: expected velocity_resolution >= 2 and velocity_scale > 0, got "
                f"{velocity_resolution} and {velocity_scale}."
            )
        warp()  # raises early where it is not installed
        self.material, self.domain, self.velocity_scale = material, domain, velocity_scale
        self.filled: list[int] = []  # points that fill the interior of each scene
        self._bodies = [self._body(i, self.drive(scene)) for i, scene in enumerate(self.scenes)]
        self.velocity = nn.ModuleList(TriPlaneField(velocity_resolution, outputs=3) for _ in self.scene_of_sequence)
        # Where free bodies begin, from rest [longest sides].
        free = any(scene.surroundings.free for scene in self.scenes)
        self.shift = nn.Parameter(torch.zeros(len(self.scene_of_sequence), 3)) if free else None

    def drive(self, scene: GaussianScene) -> Driven:
        """The particles of a scene and the kernels that follow them."""
        raise NotImplementedError

    def interior(self, scene: GaussianScene) -> Float[Tensor, "M 3"] | None:
        """Points that fill the interior of a scene, counted in :attr:`filled` [scene units]; None without filling."""
        filling = self.domain.settings.filling
        if filling is None:
            self.filled.append(0)
            return None
        mapping, body = self.domain.mapping(scene), scene.select(scene.simulated)
        means, opacities = mapping.to_simulation(body.means), torch.sigmoid(body.opacity_logits)
        covars = mapping.scale**2 * covariance_from_scales(body.log_scales, body.quats)
        found = mapping.to_scene(fill_interior(means, covars, opacities, self.domain.size, filling))
        self.filled.append(len(found))
        return found

    def modulus(self, scene_id: int) -> Float[Tensor, " P"]:
        """Young's modulus of the particles [simulation units]."""
        raise NotImplementedError

    def _body(self, scene_id: int, driven: Driven) -> Body:
        scene, domain = self.scenes[scene_id], self.domain
        settings, grid = domain.settings, domain.grid_of(scene)
        mapping, step = domain.mapping(scene), TimeStep(1 / self.fps[scene_id], courant=settings.courant)
        particles = Particles.create(
            mapping.to_simulation(driven.rest), grid=grid, density=self.material.density, pinned=driven.pinned
        )
        solver = MPMSolver(particles, self.material, grid, step)
        return Body(driven, mapping, self.places(scene, driven.rest), solver)

    @staticmethod
    def places(scene: GaussianScene, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Coordinates of a scene's points in the fields; they depend neither on the particles nor on the domain."""
        low, high = (corner.to(points) for corner in extent(scene))
        return (points - (low + high) / 2) / ((high - low).amax() / 2)

    def body(self, scene_id: int) -> Body:
        """A scene on the device of the parameters."""
        found = self._bodies[scene_id]
        if found.driven.rest.device != self._device:
            found = self._bodies[scene_id] = self._body(scene_id, moved(found.driven, self._device))
        return found

    def begin(self, sequence_id: int) -> FittedState:
        """The rest state with the fitted velocity."""
        body = self.body(self.scene_of_sequence[sequence_id])
        speed = self.domain.side * self.velocity_scale
        velocity = speed * self.velocity[sequence_id](body.places) * ~body.driven.pinned[:, None]
        shift = self._shift(sequence_id)
        particles = ParticleState.at_rest(body.mapping.to_simulation(body.driven.rest + shift), velocity)
        first = super().begin(sequence_id)
        return replace(first, positions=first.positions + shift, inner=particles.tensors())

    def _shift(self, sequence_id: int) -> Float[Tensor, " 3"]:
        """Where a body is in frame 0, from rest [scene units]."""
        scene = self.scenes[self.scene_of_sequence[sequence_id]]
        if self.shift is None or not scene.surroundings.free:
            return torch.zeros(3, device=self._device)
        low, high = extent(scene)
        return float((high - low).amax()) * self.shift[sequence_id]

    def advance(self, state: FittedState) -> FittedState:
        """One frame of substeps; differentiable.

        Raises:
            DivergenceError: a particle left the domain or is not finite.
        """
        scene_id = self.scene_of_sequence[state.sequence_id]
        body, young = self.body(scene_id), self.modulus(scene_id)
        particles = body.solver.advance(ParticleState(*state.inner), state.frame, young_modulus=young)
        x = body.mapping.to_scene(particles.positions)
        return FittedState(
            state.sequence_id,
            state.frame + 1,
            *body.driven.carried(x, particles.deformation_gradients),
            particles.tensors(),
        )

    def speed(self, scene_id: int) -> Float[Tensor, " P"]:
        """The speed sqrt(E / rho) of waves [longest sides / frame], on which the motion depends."""
        fast = torch.sqrt(self.modulus(scene_id) / self.material.density)
        return fast / (self.domain.side * self.fps[scene_id])

    def substeps(self, scene_id: int) -> int:
        """Substeps per frame with the present moduli."""
        with torch.no_grad():
            return self.body(scene_id).solver.substeps(self.modulus(scene_id))

    def description(self, scene_id: int) -> str:
        """One scene's particles, moduli and substeps in a sentence."""
        with torch.no_grad():
            moduli, speed = self.modulus(scene_id), float(self.speed(scene_id).log().mean().exp())
        least, mean, most = (f"{float(e):.3g}" for e in (moduli.amin(), moduli.log().mean().exp(), moduli.amax()))
        spread = "" if least == most else f" ({least} to {most})"
        inside = f"{self.filled[scene_id]} points" if self.filled[scene_id] else "nothing"
        return (
            f"{self.scenes[scene_id].name}: {len(self._bodies[scene_id].driven.rest)} particles, the interior filled "
            f"with {inside}, Young's modulus {mean}{spread}, waves of {speed:.2g} sides per frame, "
            f"{self.substeps(scene_id)} substeps per frame"
        )

    def parameter_groups(self) -> Mapping[str, Sequence[Parameter]]:
        """``velocity``: one field per sequence, and the places where free bodies begin."""
        places = [] if self.shift is None else [self.shift]
        return {"velocity": [*self.velocity.parameters(), *places]}

    def penalties(self, sequence_id: int) -> Mapping[str, Tensor]:
        """``velocity_variation``: of the planes of the velocity field."""
        return {"velocity_variation": cast(TriPlaneField, self.velocity[sequence_id]).planes.variation()}


def require_modulus(value: float) -> float:
    """``value``, if it is within the range of Young's modulus.

    Raises:
        ConfigError: the value is out of range.
    """
    if not (math.isfinite(value) and LEAST_MODULUS <= value <= GREATEST_MODULUS):
        raise ConfigError(
            f"model.method.material.young_modulus: expected {LEAST_MODULUS:g} .. {GREATEST_MODULUS:g} [simulation "
            f"units], got {value:g}. Periods scale with sqrt(density / young_modulus): change the density, too, to go "
            "further."
        )
    return value
