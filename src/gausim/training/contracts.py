"""What training asks of a simulator that learns: steps over a disjoint graph of several sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Tensor
from torch.nn import Module, Parameter

from gausim.core import GaussianScene, SimState


@runtime_checkable
class Member(Protocol):
    """One sequence of a batch.

    Attributes:
        scene_id: index of its scene.
        kernels: its rows of positions.
        units: its rows of gradients and rotations.
        unit_of_kernel: (K,) the unit of each kernel, counted within ``units``.
    """

    scene_id: int
    kernels: slice
    units: slice
    unit_of_kernel: Tensor


@runtime_checkable
class SceneBatch(Protocol):
    """Several sequences, also of different scenes, as one disjoint graph.

    Attributes:
        rest: (K over all members, 3) rest positions [scene units].
        members: the sequences, in the order that was asked for.
    """

    rest: Tensor
    members: tuple[Any, ...]


@runtime_checkable
class Step(Protocol):
    """One predicted frame of a batch.

    Attributes:
        positions: (K over all members, 3) kernel means [scene units].
        deformation_gradients: (N over all members, 3, 3) accumulated deformation gradients of the units.
        rotations: (N over all members, 3, 3) their accumulated rotations.
        momentum: the momentum loss, summed over members; zero where it is switched off.
    """

    positions: Tensor
    deformation_gradients: Tensor
    rotations: Tensor
    momentum: Tensor


@runtime_checkable
class Simulator(Protocol):
    """The dynamics as training sees it; a torch module besides.

    Attributes:
        scenes: the rest scenes; their index is the ``scene_id`` of samples.
    """

    scenes: Sequence[GaussianScene]

    def batch(self, scene_ids: Sequence[int]) -> Any:
        """The disjoint graph of one sequence per entry."""

    def prepare(self, batch: Any) -> Any:
        """What steps of a batch share while no parameter changes; gradients flow through it.

        One serves the steps of one stretch: the next backward pass needs another.
        """

    def step(self, batch: Any, state: SimState, force: Tensor | None = None, prepared: Any = None) -> Any:
        """Predicts the next frame of all members; ``prepared`` is made for this step alone when None."""

    def parameter_groups(self) -> dict[str, list[Parameter]]:
        """Trainable parameters: ``network`` (shared by all scenes), ``scene`` (densities, attributes), ``template``."""


@runtime_checkable
class Transferable(Simulator, Protocol):
    """A simulator of which another run may take over a part."""

    def shared(self) -> dict[str, Module]:
        """What all scenes have in common, by its name within the simulator: networks, statistics of their inputs."""

    def own(self, scene_id: int) -> tuple[str, ...]:
        """What a scene has of its own: prefixes of names in the simulator's state dict."""

    def freeze(self, *, scenes: bool = False) -> None:
        """Keeps what :meth:`shared` names as it is from now on; with ``scenes`` what they have of their own, too."""


@runtime_checkable
class Hierarchical(Protocol):
    """A simulator whose kernels belong to units of several levels."""

    def units_of_kernels(self, scene_id: int) -> Sequence[Tensor]:
        """(K,) the unit of every kernel of the scene at each level above the kernels; -1 for those never simulated."""


@runtime_checkable
class Energetic(Protocol):
    """A simulator that may know the energy of a state.

    Attributes:
        knows_energy: whether it does.
    """

    @property
    def knows_energy(self) -> bool:
        """Whether :meth:`energy` can be asked."""

    def energy(self, batch: Any, state: SimState, prepared: Any = None) -> Tensor:
        """(S,) energy of every member of the batch, up to a factor per scene; ``prepared`` as in a step."""


@runtime_checkable
class Mixing(Protocol):
    """A simulator that may tell how far its template has left the body it began with."""

    def mixing(self, scene_id: int) -> Tensor | None:
        """A number per scene, differentiable, 0 at the start; None where no body is learned."""


@runtime_checkable
class InitialVelocities(Protocol):
    """The frame before the first of every training sequence; a torch module with one parameter per sequence."""

    def previous(self, sequence_id: int) -> Tensor:
        """(K, 3) positions one frame before frame 0 [scene units]."""

    def reach(self, change: float) -> float:
        """How far that frame moves when a parameter changes by ``change`` [diagonals]."""
