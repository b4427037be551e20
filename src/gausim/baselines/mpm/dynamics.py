"""The material point method as dynamics of a scene: every simulated kernel is a particle."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.baselines.mpm.conditions import Conditions
from gausim.baselines.mpm.config import Grid, Material, TimeStep
from gausim.baselines.mpm.filling import Filling, fill_interior
from gausim.baselines.mpm.mapping import SceneMapping
from gausim.baselines.mpm.particles import Particles, ParticleState
from gausim.baselines.mpm.solver import MPMSolver
from gausim.core import ConfigError, Forces, GaussianScene, SimState, SteppedFrame, Trajectory, roll_out
from gausim.ops.covariance import covariance_from_scales, kernel_volumes
from gausim.ops.deformation import determinant, polar_rotation

FOLLOWED = 8  # kernels whose motion a filled particle begins with
LEAST_DETERMINANT = 1e-4  # below it the polar rotation is taken from singular values
ORTHOGONAL = 1e-4  # and where Newton's iteration ends further than this from a rotation


@dataclass(frozen=True, eq=False)
class Follow:
    """Filled particles between kernels: a weighted mean of the nearest ones.

    Attributes:
        kernels: numbers among the simulated kernels.
        weights: inverse distances, of sum 1.
    """

    kernels: Int[Tensor, "M n"]
    weights: Float[Tensor, "M n"]

    @staticmethod
    def nearest(filled: Float[Tensor, "M 3"], kernels: Float[Tensor, "S 3"]) -> Follow:
        """Every filled particle follows its :data:`FOLLOWED` nearest kernels, the nearest first."""
        ranks = list(range(1, min(FOLLOWED, len(kernels)) + 1))
        distances, numbers = cKDTree(kernels.cpu().numpy()).query(filled.cpu().numpy(), ranks)
        weights = 1 / torch.from_numpy(distances).to(kernels).clamp_min(1e-9)
        return Follow(torch.from_numpy(numbers).to(kernels.device), weights / weights.sum(1, keepdim=True))

    def of(self, values: Float[Tensor, "S 3"]) -> Float[Tensor, "M 3"]:
        """Values of the filled particles."""
        return (values[self.kernels] * self.weights[..., None]).sum(1)


class MPMDynamics:
    """Rolls a scene out by the material point method.

    The particles are the simulated kernels, and after them those that fill the interior, if asked for. Covariances and
    colours follow the elastic deformation gradient F and its polar rotation, one unit per kernel.

    Args:
        scene: the rest scene.
        fps: frames per second.
        material: the material [simulation units].
        grid: the background grid [simulation units].
        mapping: from the scene's coordinates to the simulation's; PhysGaussian's if not given.
        conditions: prescribed motions and impulses, in the scene's coordinates; the kernels that the scene's mask
            ``pinned`` marks are held anyway.
        filling: how the interior is filled; None leaves it empty.
        substeps: per frame; None derives them from the bound of the time step.
        courant: c of that bound.
        young_modulus: E per simulated kernel; the material's if not given.
    """

    def __init__(
        self,
        scene: GaussianScene,
        *,
        fps: float,
        material: Material,
        grid: Grid,
        mapping: SceneMapping | None = None,
        conditions: Conditions | None = None,
        filling: Filling | None = None,
        substeps: int | None = None,
        courant: float = 0.3,
        young_modulus: Float[Tensor, " S"] | None = None,
    ) -> None:
        self.scene, self.fps, self.material = scene, fps, material
        self.mapping = mapping or SceneMapping.physgaussian(scene.means[scene.simulated])
        self._index = scene.simulated.nonzero()[:, 0]
        body = scene.select(scene.simulated)
        rest = self.mapping.to_simulation(body.means)
        self._filled, self._follow = self._fill(body, rest, grid, filling)
        nearest = self._follow.kernels[:, 0]
        particles = Particles.create(
            torch.cat((rest, self._filled)),
            grid=grid,
            density=material.density,
            pinned=torch.cat((body.pinned, body.pinned[nearest])),
        )
        mapped = (conditions or Conditions()).mapped(self.mapping)
        self.solver = MPMSolver(particles, material, grid, TimeStep(1 / fps, substeps, courant), mapped)
        E = rest.new_full((len(rest),), material.young_modulus) if young_modulus is None else young_modulus
        self.young_modulus = torch.cat((E, E[nearest]))
        self._kernel_mass = kernel_volumes(body.log_scales, scene.volume_scale)

    def _fill(self, body: GaussianScene, rest: Tensor, grid: Grid, filling: Filling | None) -> tuple[Tensor, Follow]:
        filled = rest.new_zeros(0, 3)
        if filling is not None:
            covars = self.mapping.scale**2 * covariance_from_scales(body.log_scales, body.quats)
            filled = fill_interior(rest, covars, torch.sigmoid(body.opacity_logits), grid, filling)
        return filled, Follow.nearest(filled, rest)

    def start(self, initial: SimState) -> ParticleState:
        """Undeformed particles where the kernels are, with the velocities (x_t - x_t-1) fps."""
        x, before = (self.mapping.to_simulation(p[self._index]) for p in (initial.positions, initial.previous))
        displacement = x - self.mapping.to_simulation(self.scene.means[self._index])
        velocities = (x - before) * self.fps
        x = torch.cat((x, self._filled + self._follow.of(displacement)))
        velocities = torch.cat((velocities, self._follow.of(velocities)))
        velocities = velocities * ~self.solver.particles.pinned[:, None]
        return ParticleState.at_rest(x, velocities, material=self.material)

    def advance(self, state: ParticleState, frame: int, force: Float[Tensor, "K 3"] | None = None) -> ParticleState:
        """One frame; differentiable.

        Args:
            state: particles at its start.
            frame: its number, from 0.
            force: per kernel [kernel mass * scene units / s^2]; it accelerates the kernel's particle by force / mass.
                Filled particles do not feel it.
        """
        acceleration = None
        if force is not None:
            pushed = self.mapping.scale * force[self._index] / self._kernel_mass[:, None]
            acceleration = torch.cat((pushed, torch.zeros_like(self._filled)))
        return self.solver.advance(state, frame, young_modulus=self.young_modulus, acceleration=acceleration)

    @torch.no_grad()
    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; frame 0 is the initial state with identity gradients.

        Raises:
            ConfigError: the configured number of substeps violates the bound of the time step.
            DivergenceError: a particle left the domain or is not finite.
        """
        return roll_out(self.stepper(initial), steps, forces)

    def stepper(self, initial: SimState) -> MPMStepper:
        """Begins at a state; every step is one of :meth:`rollout`."""
        return MPMStepper(self, initial)

    def kernel_positions(self, state: ParticleState, initial: SimState) -> Float[Tensor, "K 3"]:
        """Positions of all kernels of the scene; what is not simulated or is pinned stays [scene units]."""
        moved = self.mapping.to_scene(state.positions[: len(self._index)]).to(initial.positions)
        free = ~self.scene.pinned[self._index]
        return initial.positions.index_put((self._index[free],), moved[free])

    def unit_deformations(self, state: ParticleState) -> Float[Tensor, "N 3 3"]:
        """F of the simulated kernels and, last, the identity for the others."""
        deformation_gradients = state.deformation_gradients[: len(self._index)]
        return torch.cat((deformation_gradients, torch.eye(3).to(deformation_gradients)[None]))

    @property
    def unit_of_kernel(self) -> Int[Tensor, " K"]:
        """Every simulated kernel that is not pinned is a unit; the last unit is the identity."""
        units = torch.full((self.scene.count,), len(self._index), dtype=torch.long, device=self._index.device)
        units[self._index] = torch.arange(len(self._index), device=self._index.device)
        return torch.where(self.scene.pinned, len(self._index), units)

    def with_young_modulus(self, young_modulus: Float[Tensor, " S"]) -> MPMDynamics:
        """The same with other moduli of the simulated kernels (shares the solver)."""
        other = copy.copy(self)
        other.young_modulus = torch.cat((young_modulus, young_modulus[self._follow.kernels[:, 0]]))
        return other


class MPMStepper:
    """The material points of one scene, frame by frame: :class:`gausim.core.Stepper`.

    Attributes:
        state: the two latest positions of all kernels [scene units].
        frame: the latest frame.
        unit_of_kernel: the unit of each kernel.
        fps: frames per second.
        takes_forces: True; no kernels can be held beside those that the scene pins.
        limited: 0; whatever forces do is simulated.
    """

    takes_forces: bool = True
    limited: int = 0

    def __init__(self, dynamics: MPMDynamics, initial: SimState) -> None:
        """Begins at ``initial``."""
        self._dynamics, self._initial, self._number = dynamics, initial, 0
        self._particles = dynamics.start(initial)
        unit_of_kernel = dynamics.unit_of_kernel
        identity = torch.eye(3).to(initial.positions).expand(len(dynamics._index) + 1, 3, 3)
        self.state, self.frame = initial, SteppedFrame(initial.positions, identity, identity)
        self.unit_of_kernel: Int[Tensor, " K"] = unit_of_kernel
        self.fps: float = dynamics.fps

    @torch.no_grad()
    def step(self, force: Float[Tensor, "K 3"] | None = None, *, held: Tensor | None = None) -> SteppedFrame:
        """The next frame.

        Raises:
            ConfigError: kernels to hold, or the configured number of substeps violates the bound of the time step.
            DivergenceError: a particle left the domain or is not finite.
        """
        if held is not None and bool(held.any()):
            raise ConfigError("the material point method holds no more kernels than the scene pins. Unpin the others.")
        self._particles = self._dynamics.advance(self._particles, self._number, force)
        self._number += 1
        positions = self._dynamics.kernel_positions(self._particles, self._initial)
        deformation_gradients = self._dynamics.unit_deformations(self._particles)
        self.state = SimState(positions, self.state.positions)
        self.frame = SteppedFrame(positions, deformation_gradients, rotations(deformation_gradients))
        return self.frame

    def settle(self) -> None:
        """Nothing: every step says at once what is wrong."""


def rotations(deformation_gradients: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 3 3"]:
    """Polar rotations with determinant 1, also of matter that is turned inside out."""
    identity = torch.eye(3).to(deformation_gradients)
    upright = (determinant(deformation_gradients) > LEAST_DETERMINANT)[..., None, None]
    result = polar_rotation(torch.where(upright, deformation_gradients, identity))
    turned = (result @ result.mT - identity).abs().amax((-1, -2), keepdim=True) < ORTHOGONAL
    if (upright & turned).all():
        return result
    u, _, vt = torch.linalg.svd(deformation_gradients)
    sign = torch.ones_like(u[..., 0, :])
    sign[..., 2] = determinant(u @ vt).sign()
    return torch.where(upright & turned, result, (u * sign[..., None, :]) @ vt)
