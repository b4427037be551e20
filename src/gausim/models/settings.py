"""Settings of a simulator's hierarchy and of its rollouts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gausim.core import ConfigError

EDGES = ("rest", "union", "intersection")


@dataclass(frozen=True)
class HierarchySettings:
    """Settings of the hierarchy of units and of the graphs between them (METHOD section 1).

    Attributes:
        levels: the predicted levels, coarse to fine: `diameter` of the clusters and `edge_length` of the graph, both as
            fractions of the object's diagonal. The last level may have diameter 0: its units are the kernels. A single
            level of diameter 0 means "without hierarchy".
        max_neighbours: edges per unit.
        edges: neighbours in ``rest`` space, or the ``union`` / ``intersection`` with those of the current state.
        body_frame: predict in body axes, so that the motion is equivariant to rotations and translations of the scene.

    Raises:
        ConfigError: no level, an unknown key, diameters that do not decrease, or an unknown rule of edges.
    """

    levels: Sequence[Mapping[str, float]] = (
        {"diameter": 0.55, "edge_length": 2.0},
        {"diameter": 0.125, "edge_length": 0.3},
    )
    max_neighbours: int = 8
    edges: str = "rest"
    body_frame: bool = True

    def __post_init__(self) -> None:
        if self.edges not in EDGES:
            raise ConfigError(f"model.simulator.hierarchy.edges is '{self.edges}'; expected one of {', '.join(EDGES)}.")
        if not self.levels or any(set(level) != {"diameter", "edge_length"} for level in self.levels):
            raise ConfigError(
                "model.simulator.hierarchy.levels: expected at least one {diameter, edge_length}, got "
                f"{[dict(level) for level in self.levels]}."
            )
        diameters = [float(level["diameter"]) for level in self.levels]
        if diameters != sorted(set(diameters), reverse=True) or diameters[-1] < 0:
            raise ConfigError(
                f"model.simulator.hierarchy.levels: expected falling diameters, coarse to fine, got {diameters}."
            )

    @property
    def diameters(self) -> tuple[float, ...]:
        """Cluster diameters of levels 1..L of the hierarchy, fine to coarse [fractions of the diagonal]."""
        return tuple(float(level["diameter"]) for level in reversed(self.levels) if level["diameter"])

    @property
    def predicted(self) -> tuple[int, ...]:
        """Levels of the hierarchy for which F is predicted, coarse to fine; level 0 are the kernels."""
        first = len(self.diameters)
        return tuple(first - position for position in range(len(self.levels)))

    @property
    def edge_lengths(self) -> tuple[float, ...]:
        """Largest edge length per predicted level, coarse to fine [fractions of the diagonal]."""
        return tuple(float(level["edge_length"]) for level in self.levels)


@dataclass(frozen=True)
class RolloutSettings:
    """Settings of rollouts; the energy guard is for those without loss gradients.

    Attributes:
        cuda_graph: on a CUDA device steps, and in training whole rollouts with their backward pass, are replayed as one
            graph (:class:`gausim.training.graphed.GraphedRollouts`); no effect on other devices.
        energy_guard_frames: number of past frames, of whose largest energy (in the template's terms) the network may
            not exceed what damping leaves (:class:`gausim.models.rollout.energy_guard.EnergyGuard`); 0: no limit. Of a
            taught network without such an energy it is that of an oscillator
            (:class:`gausim.models.rollout.amplitude_guard.AmplitudeGuard`).
    """

    cuda_graph: bool = False
    energy_guard_frames: int = 36
