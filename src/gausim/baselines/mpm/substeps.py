"""One substep and its adjoint as sequences of Warp launches on arrays that the caller owns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid, Material
from gausim.baselines.mpm.particles import Particles
from gausim.baselines.mpm.runtime import warp
from gausim.kernels.announce import announced


@dataclass(frozen=True, eq=False)
class State:
    """The four arrays of a particle state, or of its adjoint, as Warp sees them."""

    positions: Any
    velocities: Any
    affine: Any
    deformation_gradients: Any

    @staticmethod
    def of(tensors: tuple[Tensor, ...]) -> State:
        """Views of contiguous float32 tensors (x, v, C, F); no copies."""
        wp = warp()
        kinds = (wp.vec3, wp.vec3, wp.mat33, wp.mat33)
        return State(*(wp.from_torch(t.detach(), dtype=kind) for t, kind in zip(tensors, kinds, strict=True)))

    def all(self) -> list[Any]:
        """The arrays in the order of the kernels' outputs."""
        return [self.positions, self.velocities, self.affine, self.deformation_gradients]

    def zero(self) -> None:
        """Sets all numbers to 0."""
        for array in self.all():
            array.zero_()


MARGIN = 4  # cells that particles may move within a frame before a larger window is needed


class Window:
    """The nodes that a frame computes on: a block round the particles, or the whole grid.

    Attributes:
        origin: number of its first node per axis.
        shape: nodes per axis.
        momentum: momentum (x, y, z) and mass (w) of the nodes.
        velocity: their velocity.
    """

    def __init__(self, origin: tuple[int, int, int], shape: tuple[int, int, int], device: Any) -> None:
        wp = warp()
        self.origin, self.shape = origin, shape
        self.momentum = wp.zeros(shape, dtype=wp.vec4, device=device)
        self.velocity = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.origin_, self.shape_ = wp.vec3(*map(float, origin)), wp.vec3i(*shape)

    def holds(self, positions: Float[Tensor, "N 3"], dx: float) -> bool:
        """Whether all nodes of all particles are in the window."""
        x = positions / dx - positions.new_tensor(self.origin)
        return bool(((x >= 0.5) & (x < positions.new_tensor(self.shape) - 1.5)).all())


class Substeps:
    """Launches the four kernels of a substep forwards and backwards.

    A window and one array of stresses are all it works on: the adjoint of a substep computes them again from the state
    at its start.

    Args:
        particles: mass, volume and pins, on the device to compute on.
        material: the material of all particles.
        grid: the grid.
    """

    def __init__(self, particles: Particles, material: Material, grid: Grid) -> None:
        wp = warp()
        from gausim.baselines.mpm.device_code import transfer

        self._wp, self._kernels = wp, transfer
        self.device = wp.device_from_torch(particles.mass.device)
        with announced("the material point method", keeper="Warp"):
            wp.load_module(transfer.__name__, device=self.device)
        self.count = len(particles.mass)
        self._grid, self._material = grid, material
        # Warp's views do not own the memory of the tensors they look at.
        held, pinned = particles.pinned.to(torch.uint8), particles.pinned_nodes.to(torch.uint8)
        self._alive = [t.contiguous() for t in (particles.mass, particles.volume, held, pinned)]
        mass, volume, held, pinned = self._alive
        self._mass, self._volume = wp.from_torch(mass), wp.from_torch(volume)
        self._held, self._pinned_nodes = wp.from_torch(held), wp.from_torch(pinned)
        self._stress, self._adjoint_stress = (wp.zeros(self.count, dtype=wp.mat33, device=self.device) for _ in "ab")

    def window(self, positions: Float[Tensor, "N 3"] | None = None) -> Window:
        """The nodes round these particles and :data:`MARGIN` more on each side; all nodes without particles."""
        last = self._grid.cells
        if positions is None or not len(positions) or not torch.isfinite(positions).all():
            return Window((0, 0, 0), (last + 1,) * 3, self.device)
        low = (positions.amin(0) / self._grid.dx - 0.5).floor().long() - MARGIN
        high = (positions.amax(0) / self._grid.dx - 0.5).floor().long() + 2 + MARGIN
        first, end = low.clamp(0, last).tolist(), high.clamp(0, last).tolist()
        x, y, z = (b - a + 1 for a, b in zip(first, end, strict=True))
        return Window((first[0], first[1], first[2]), (x, y, z), self.device)

    def forward(self, window: Window, state: State, following: State, young: Any, acceleration: Any, dt: float) -> None:
        """Writes the state after a substep of ``dt`` to ``following``."""
        self._to_grid(window, state, young, acceleration, dt)
        inputs, outputs = self._gather(window, state, following, dt)
        self._launch(self._kernels.grid_to_particles, self.count, inputs, outputs)

    def backward(
        self,
        windows: tuple[Window, Window],
        states: tuple[State, State],
        adjoints: tuple[State, State],
        young: tuple[Any, Any],
        acceleration: tuple[Any, Any],
        dt: float,
    ) -> None:
        """Overwrites the first of ``adjoints`` from the second, and adds to those of ``young`` and ``acceleration``.

        Args:
            windows: one for values, one of the same nodes for adjoints.
            states: at the start and the end of the substep.
            adjoints: of these states.
            young: values and adjoints.
            acceleration: values and adjoints.
            dt: its duration [s].
        """
        (window, adjoint_window), (state, following), (adjoint, adjoint_following) = windows, states, adjoints
        momentum, velocity, stress = adjoint_window.momentum, adjoint_window.velocity, self._adjoint_stress
        for array in (momentum, velocity, stress):
            array.zero_()
        adjoint.zero()
        self._to_grid(window, state, young[0], acceleration[0], dt)

        inputs, outputs = self._gather(window, state, following, dt)
        to = [adjoint.positions, adjoint.deformation_gradients, velocity, None, *inputs[4:]]
        self._adjoint(self._kernels.grid_to_particles, self.count, inputs, outputs, to, adjoint_following.all())
        inputs, outputs = self._update(window, dt)
        to = [momentum, None, *inputs[2:]]
        self._adjoint(self._kernels.grid_update, window.shape, inputs, outputs, to, [velocity])
        inputs, outputs = self._scatter(window, state, acceleration[0], dt)
        to = [adjoint.positions, adjoint.velocities, adjoint.affine, stress, acceleration[1], None, None, *inputs[7:]]
        self._adjoint(self._kernels.particles_to_grid, self.count, inputs, outputs, to, [momentum])
        inputs, outputs = self._stresses(state, young[0])
        to = [adjoint.deformation_gradients, young[1], *inputs[2:]]
        self._adjoint(self._kernels.stress_kernel, self.count, inputs, outputs, to, [stress])

    def _to_grid(self, window: Window, state: State, young: Any, acceleration: Any, dt: float) -> None:
        window.momentum.zero_()
        self._launch(self._kernels.stress_kernel, self.count, *self._stresses(state, young))
        self._launch(self._kernels.particles_to_grid, self.count, *self._scatter(window, state, acceleration, dt))
        self._launch(self._kernels.grid_update, window.shape, *self._update(window, dt))

    def _stresses(self, state: State, young: Any) -> tuple[list[Any], list[Any]]:
        inputs = [state.deformation_gradients, young, self._material.poisson_ratio]
        return inputs, [self._stress]

    def _scatter(self, window: Window, state: State, acceleration: Any, dt: float) -> tuple[list[Any], list[Any]]:
        moving = [state.positions, state.velocities, state.affine, self._stress, acceleration]
        numbers = [1 / self._grid.dx, window.origin_, window.shape_, dt]
        return [*moving, self._mass, self._volume, *numbers], [window.momentum]

    def _update(self, window: Window, dt: float) -> tuple[list[Any], list[Any]]:
        grid = self._grid
        kept = max(0.0, 1 - grid.damping * dt)
        numbers = [self._wp.vec3(*grid.gravity), kept, window.origin_, dt]
        return [window.momentum, self._pinned_nodes, *numbers], [window.velocity]

    def _gather(self, window: Window, state: State, following: State, dt: float) -> tuple[list[Any], list[Any]]:
        arrays = [state.positions, state.deformation_gradients, window.velocity, self._held]
        return [*arrays, 1 / self._grid.dx, window.origin_, window.shape_, dt], following.all()

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
