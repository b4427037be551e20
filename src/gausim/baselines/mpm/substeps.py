"""Substeps and their adjoint as Warp launches on the caller's arrays; Warp is imported when they are first needed."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid, Material, Slope
from gausim.baselines.mpm.particles import Particles
from gausim.core import ConfigError
from gausim.kernels.announce import announced

MARGIN = 4  # cells that particles may move within a frame before a larger window is needed


def warp() -> Any:
    """The module ``warp``, initialised without its banner.

    Raises:
        ConfigError: Warp is not installed.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise ConfigError(
            "the material point method needs NVIDIA Warp, which is not installed: pip install 'gausim[baselines]'."
        ) from error
    if wp.config.log_level < wp.LOG_WARNING:
        wp.config.log_level = wp.LOG_WARNING
    wp.init()
    return wp


def on_stream_of(device: torch.device) -> AbstractContextManager[Any]:
    """Runs a block on torch's stream of a CUDA device, so that the work of both libraries stays in order."""
    wp = warp()
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))


def views(tensors: Sequence[Tensor]) -> list[Any]:
    """Warp arrays on the memory of a particle state's contiguous float32 tensors (x, v, C, F)."""
    wp = warp()
    kinds = (wp.vec3, wp.vec3, wp.mat33, wp.mat33)
    return [wp.from_torch(t.detach(), dtype=kind) for t, kind in zip(tensors, kinds, strict=True)]


class Window:
    """The nodes of one frame: a block around the particles, or the whole grid.

    Attributes:
        origin: number of its first node per axis.
        shape: nodes per axis.
        momentum: momentum (x, y, z) and mass (w) of the nodes.
        velocity: their velocity.
    """

    def __init__(self, origin: Sequence[int], shape: Sequence[int], device: Any, *, adjoint: bool = False) -> None:
        """Arrays of zeros; ``adjoint`` adds those of the adjoint."""
        wp = warp()
        self.origin, self.shape = tuple(origin), tuple(shape)
        self.momentum = wp.zeros(self.shape, dtype=wp.vec4, device=device, requires_grad=adjoint)
        self.velocity = wp.zeros(self.shape, dtype=wp.vec3, device=device, requires_grad=adjoint)

    def holds(self, positions: Float[Tensor, "N 3"], dx: float) -> bool:
        """True if all nodes of all particles are in the window."""
        x = positions / dx - positions.new_tensor(self.origin)
        return bool(((x >= 0.5) & (x < positions.new_tensor(self.shape) - 1.5)).all())


class Substeps:
    """Launches the four kernels of a substep forwards and backwards.

    The working memory is a window and one array of stresses: the adjoint of a substep recomputes both from the
    state at its start.
    """

    def __init__(self, particles: Particles, material: Material, grid: Grid) -> None:
        wp = warp()
        from gausim.baselines.mpm import device_code

        self._wp, self._kernels, self._grid, self._material = wp, device_code, grid, material
        self.device = wp.device_from_torch(particles.mass.device)
        with announced("the material point method", compiler="Warp"):
            wp.load_module(device_code.__name__, device=self.device)
        self.count = len(particles.mass)
        # Warp's views do not own the memory of their tensors.
        held, pinned = particles.pinned.to(torch.uint8), particles.pinned_nodes.to(torch.uint8)
        self._alive = [t.contiguous() for t in (particles.mass, particles.volume, held, pinned)]
        self._mass, self._volume, self._held, self._pinned_nodes = (wp.from_torch(t) for t in self._alive)
        self._stress = wp.zeros(self.count, dtype=wp.mat33, device=self.device, requires_grad=True)

    def window(self, positions: Float[Tensor, "N 3"] | None = None) -> Window:
        """The nodes around the particles and :data:`MARGIN` more on each side; all nodes without particles."""
        last = self._grid.cells
        if positions is None or not len(positions) or not torch.isfinite(positions).all():
            return Window((0, 0, 0), (last + 1,) * 3, self.device)
        low = (positions.amin(0) / self._grid.dx - 0.5).floor().long() - MARGIN
        high = (positions.amax(0) / self._grid.dx - 0.5).floor().long() + 2 + MARGIN
        first, end = low.clamp(0, last), high.clamp(0, last)
        return Window(first.tolist(), (end - first + 1).tolist(), self.device)

    def forward(self, window: Window, state: list[Any], following: list[Any], young: Any, dt: float) -> None:
        """Writes the state (:func:`views`) after a substep of ``dt`` to ``following``."""
        window.momentum.zero_()
        for launch in self._launches(window, state, following, young, dt):
            self._wp.launch(*launch, device=self.device)

    def backward(self, window: Window, state: list[Any], following: list[Any], young: Any, dt: float) -> None:
        """Overwrites ``grad`` of the state by the adjoint of that of ``following``, and adds to that of ``young``.

        The arrays are those of :meth:`forward`; all, and the window, have a ``grad``.
        """
        for array in (window.momentum, window.velocity, self._stress, *state):
            array.grad.zero_()
        window.momentum.zero_()
        launches = self._launches(window, state, following, young, dt)
        for launch in launches[:-1]:  # ``following`` is known already
            self._wp.launch(*launch, device=self.device)
        for kernel, size, inputs, outputs in reversed(launches):
            adjoints: Any = {
                "adj_inputs": [getattr(x, "grad", x) for x in inputs],
                "adj_outputs": [x.grad for x in outputs],
            }
            self._wp.launch(kernel, size, inputs, outputs, **adjoints, adjoint=True, device=self.device)

    def _launches(
        self, window: Window, state: list[Any], following: list[Any], young: Any, dt: float
    ) -> list[tuple[Any, Any, list[Any], list[Any]]]:
        """Kernel, size, inputs and outputs of each launch of a substep."""
        (x, v, C, F), kernels, grid = state, self._kernels, self._grid
        origin, nodes = self._wp.vec3(*map(float, window.origin)), self._wp.vec3i(*window.shape)
        pull = self._wp.vec3(*(dt * g for g in grid.gravity))
        slope = grid.slope or Slope()
        floor = [self._wp.vec3(*slope.normal), slope.level / grid.dx, slope.friction]
        scattered = [x, v, C, self._stress, self._mass, self._volume, 1 / grid.dx, origin, nodes, dt]
        updated = [window.momentum, self._pinned_nodes, pull, *floor, origin]
        gathered = [x, F, window.velocity, self._held, 1 / grid.dx, origin, nodes, dt]
        return [
            (kernels.stress_kernel, self.count, [F, young, self._material.poisson_ratio], [self._stress]),
            (kernels.particles_to_grid, self.count, scattered, [window.momentum]),
            (kernels.grid_update, window.shape, updated, [window.velocity]),
            (kernels.grid_to_particles, self.count, gathered, following),
        ]
