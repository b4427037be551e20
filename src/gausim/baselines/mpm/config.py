"""Options of a simulation: material, grid, and time step with its bound."""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError


@dataclass(frozen=True)
class Material:
    """A fixed corotated elastic material; Young's modulus may vary over the particles.

    Attributes:
        young_modulus: E of the particles for which no other is given [mass / (length s^2), simulation units].
        poisson_ratio: nu, in (-1, 0.5).
        density: mass per volume [simulation units].
    """

    young_modulus: float = 1e5
    poisson_ratio: float = 0.4
    density: float = 200.0

    def __post_init__(self) -> None:
        if not -1 < self.poisson_ratio < 0.5:
            raise ConfigError(f"poisson_ratio: expected -1 < nu < 0.5, got {self.poisson_ratio}. Rubber has 0.49.")
        for name in ("young_modulus", "density"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name}: expected a positive number, got {getattr(self, name)}.")


@dataclass(frozen=True)
class Slope:
    """A plane that matter slides on under Coulomb's friction; nodes on it or behind it have no velocity into it."""

    normal: tuple[float, float, float] = (0.0, 0.0, 0.0)  # unit vector out of the plane
    level: float = 0.0  # n . x of its points [simulation units]
    friction: float = 0.0  # Coulomb's coefficient


@dataclass(frozen=True)
class Grid:
    """The background grid over the domain [0, size]^3."""

    cells: int = 50  # cells per axis; nodes are one more
    size: float = 2.0  # edge L of the domain [simulation units]
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # acceleration of all nodes [simulation units / s^2]
    slope: Slope | None = None  # the floor; None: there is none

    def __post_init__(self) -> None:
        if self.cells < 4:
            raise ConfigError(f"cells: expected at least 4 (a particle touches 3 nodes), got {self.cells}.")
        if not 0 < self.size < math.inf:
            raise ConfigError(f"size: expected a positive edge of the domain, got {self.size}.")

    @property
    def dx(self) -> float:
        """Edge of a cell [simulation units]."""
        return self.size / self.cells


COVERED_POISSON_RATIO = 0.45  # the bound of the time step needs no factor up to this


def pressure_wave(poisson_ratio: float) -> float:
    """Speed of pressure waves over sqrt(E / rho): sqrt((1 - nu) / ((1 + nu) (1 - 2 nu)))."""
    nu = poisson_ratio
    return math.sqrt((1 - nu) / ((1 + nu) * (1 - 2 * nu)))


@dataclass(frozen=True)
class TimeStep:
    """Division of a frame into substeps."""

    frame_time: float = 1 / 30  # duration of a frame [s]
    # c of the bound dt < c dx / sqrt(E / rho). 0.3 is safe for nu up to 0.45, where pressure waves are 1.9 times
    # as fast as sqrt(E / rho); measured, 0.5 is stable up to 0.4 and 0.7 up to 0.3
    courant: float = 0.3

    def __post_init__(self) -> None:
        if not 0 < self.frame_time < math.inf:
            raise ConfigError(f"frame_time: expected a positive duration [s], got {self.frame_time}.")
        if not 0 < self.courant <= 1:
            raise ConfigError(f"courant: expected a number in (0, 1], got {self.courant}.")

    def count(
        self, dx: float, young_modulus: Float[Tensor, " N"], density: Float[Tensor, " N"], poisson_ratio: float
    ) -> int:
        """Substeps per frame: the smallest number with dt < c dx / sqrt(E / rho) for all particles.

        For nu > 0.45, sqrt(E / rho) is multiplied by the speed of pressure waves relative to that at 0.45.

        Raises:
            ConfigError: a modulus is not a positive number.
        """
        speed = float((young_modulus.detach() / density).amax()) ** 0.5 if len(density) else 0.0
        speed *= max(1.0, pressure_wave(poisson_ratio) / pressure_wave(COVERED_POISSON_RATIO))
        least = float(young_modulus.detach().amin()) if len(density) else 1.0
        if not (least > 0 and math.isfinite(speed)):
            raise ConfigError(
                f"young_modulus: expected positive numbers, got {least:.4g} .. (rho c^2, c = {speed:.4g})."
            )
        bound = self.courant * dx / speed if speed else math.inf
        return math.floor(self.frame_time / bound) + 1
