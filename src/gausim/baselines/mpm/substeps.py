"""One substep and its adjoint as sequences of Warp launches on arrays that the caller owns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gausim.baselines.mpm.config import Grid, Material
from gausim.baselines.mpm.particles import Particles
from gausim.baselines.mpm.runtime import warp


@dataclass(frozen=True, eq=False)
class State:
    """The five arrays of a particle state, or of its adjoint, as Warp sees them."""

    positions: Any
    velocities: Any
    affine: Any
    gradients: Any
    yield_stress: Any

    @staticmethod
    def of(tensors: tuple[Tensor, ...]) -> State:
        """Views of contiguous float32 tensors (x, v, C, F, y); no copies."""
        wp = warp()
        kinds = (wp.vec3, wp.vec3, wp.mat33, wp.mat33, wp.float32)
        return State(*(wp.from_torch(t.detach(), dtype=kind) for t, kind in zip(tensors, kinds, strict=True)))

    def all(self) -> list[Any]:
        """The arrays in the order of the kernels' outputs."""
        return [self.positions, self.velocities, self.affine, self.gradients, self.yield_stress]

    def zero(self) -> None:
        """Sets all numbers to 0."""
        for array in self.all():
            array.zero_()


class Substeps:
    """Launches the four kernels of a substep forwards and backwards.

    Holds one grid and one array of stresses: the adjoint of a substep computes them again from the state at its start.

    Args:
        particles: mass, volume and pins, on the device to compute on.
        material: the material of all particles.
        grid: the grid.
        boxes: prescribed motions (lower, upper, velocity, span), one row each.
    """

    def __init__(self, particles: Particles, material: Material, grid: Grid, boxes: tuple[Tensor, ...]) -> None:
        wp = warp()
        from gausim.baselines.mpm.device_code import transfer

        self._wp, self._kernels = wp, transfer
        self.device = wp.device_from_torch(particles.mass.device)
        self.count, self.nodes = len(particles.mass), (grid.cells + 1,) * 3
        self._grid, self._material = grid, material
        # Warp's views do not own the memory of the tensors they look at.
        held, pinned = particles.pinned.to(torch.uint8), particles.pinned_nodes.to(torch.uint8)
        self._alive = [t.contiguous() for t in (particles.mass, particles.volume, held, pinned, *boxes)]
        mass, volume, held, pinned, *boxes_ = self._alive
        self._mass, self._volume = wp.from_torch(mass), wp.from_torch(volume)
        self._held, self._pinned_nodes = wp.from_torch(held), wp.from_torch(pinned)
        self._boxes = [wp.from_torch(b, dtype=wp.vec3) for b in boxes_]
        self._rheology = wp.vec3(material.friction, material.plastic_viscosity, material.softening)
        self._momentum, self._velocity, self._stress = self._fields()
        self._adjoint_fields: tuple[Any, Any, Any] | None = None

    def _fields(self) -> tuple[Any, Any, Any]:
        """Momentum and mass of nodes, velocity of nodes, stress of particles."""
        wp = self._wp
        return (
            wp.zeros(self.nodes, dtype=wp.vec4, device=self.device),
            wp.zeros(self.nodes, dtype=wp.vec3, device=self.device),
            wp.zeros(self.count, dtype=wp.mat33, device=self.device),
        )

    def forward(self, state: State, following: State, young: Any, acceleration: Any, time: float, dt: float) -> None:
        """Writes the state after a substep of ``dt`` that begins at ``time`` to ``following``."""
        self._to_grid(state, young, acceleration, time, dt)
        inputs, outputs = self._gather(state, following, young, dt)
        self._launch(self._kernels.grid_to_particles, self.count, inputs, outputs)

    def backward(
        self,
        state: State,
        following: State,
        adjoint: State,
        adjoint_following: State,
        young: tuple[Any, Any],
        acceleration: tuple[Any, Any],
        time: float,
        dt: float,
    ) -> None:
        """Overwrites ``adjoint`` with that of the state, and adds to those of ``young`` and ``acceleration``.

        ``young`` and ``acceleration`` are pairs of values and adjoints.
        """
        if self._adjoint_fields is None:
            self._adjoint_fields = self._fields()
        momentum, velocity, stress = self._adjoint_fields
        for array in self._adjoint_fields:
            array.zero_()
        adjoint.zero()
        self._to_grid(state, young[0], acceleration[0], time, dt)

        inputs, outputs = self._gather(state, following, young[0], dt)
        moved = [adjoint.positions, adjoint.gradients, adjoint.yield_stress, velocity, young[1], None, *inputs[6:]]
        self._adjoint(self._kernels.grid_to_particles, self.count, inputs, outputs, moved, adjoint_following.all())
        inputs, outputs = self._update(time, dt)
        self._adjoint(
            self._kernels.grid_update, self.nodes, inputs, outputs, [momentum, *[None] * 5, *inputs[6:]], [velocity]
        )
        inputs, outputs = self._scatter(state, acceleration[0], dt)
        moved = [adjoint.positions, adjoint.velocities, adjoint.affine, stress, acceleration[1], None, None]
        self._adjoint(self._kernels.particles_to_grid, self.count, inputs, outputs, [*moved, *inputs[7:]], [momentum])
        inputs, outputs = self._stresses(state, young[0])
        moved = [adjoint.gradients, adjoint.yield_stress, young[1], *inputs[3:]]
        self._adjoint(self._kernels.stress_kernel, self.count, inputs, outputs, moved, [stress])

    def _to_grid(self, state: State, young: Any, acceleration: Any, time: float, dt: float) -> None:
        self._momentum.zero_()
        self._launch(self._kernels.stress_kernel, self.count, *self._stresses(state, young))
        self._launch(self._kernels.particles_to_grid, self.count, *self._scatter(state, acceleration, dt))
        self._launch(self._kernels.grid_update, self.nodes, *self._update(time, dt))

    def _stresses(self, state: State, young: Any) -> tuple[list[Any], list[Any]]:
        material = self._material
        inputs = [state.gradients, state.yield_stress, young, material.poisson_ratio, int(material.kind)]
        return inputs, [self._stress]

    def _scatter(self, state: State, acceleration: Any, dt: float) -> tuple[list[Any], list[Any]]:
        moving = [state.positions, state.velocities, state.affine, self._stress, acceleration]
        fixed = [self._mass, self._volume, 1 / self._grid.dx, self._grid.cells, dt]
        return [*moving, *fixed], [self._momentum]

    def _update(self, time: float, dt: float) -> tuple[list[Any], list[Any]]:
        grid = self._grid
        numbers = [self._wp.vec3(*grid.gravity), max(0.0, 1 - grid.damping * dt), grid.dx, time, dt]
        return [self._momentum, self._pinned_nodes, *self._boxes, *numbers], [self._velocity]

    def _gather(self, state: State, following: State, young: Any, dt: float) -> tuple[list[Any], list[Any]]:
        arrays = [state.positions, state.gradients, state.yield_stress, self._velocity, young, self._held]
        material = [self._material.poisson_ratio, int(self._material.kind), self._rheology]
        return [*arrays, *material, 1 / self._grid.dx, self._grid.cells, dt], following.all()

    def _launch(self, kernel: Any, size: Any, inputs: list[Any], outputs: list[Any]) -> None:
        self._wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device)

    def _adjoint(
        self, kernel: Any, size: Any, inputs: list[Any], outputs: list[Any], to: list[Any], given: list[Any]
    ) -> None:
        self._wp.launch(
            kernel,
            dim=size,
            inputs=inputs,
            outputs=outputs,
            adj_inputs=to,
            adj_outputs=given,
            adjoint=True,
            device=self.device,
        )
