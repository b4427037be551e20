"""What training asks of a simulator that learns: steps over a disjoint graph of several sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Tensor
from torch.nn import Parameter

from gausim.core import GaussianScene, SimState


@runtime_checkable
class SceneBatch(Protocol):
    """Several sequences, also of different scenes, as one disjoint graph.

    Attributes:
        rest: (K over all members, 3) rest positions [scene units].
        members: the sequences, in the order that was asked for. Each has a ``scene_id``, its rows of positions
            ``kernels`` and of gradients and rotations ``units`` (slices), and the unit of each of its kernels, counted
            within ``units`` (``unit_of_kernel``).
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

    What else :class:`gausim.models.step.scene_model.SceneModel` offers is used where a model has it: the units of its
    kernels (``units_of_kernels``), an energy (``knows_energy``, ``energy``) and its template's ``mixing``.

    Attributes:
        scenes: the rest scenes; their index is the ``scene_id`` of samples.
    """

    scenes: Sequence[GaussianScene]

    def batch(self, scene_ids: Sequence[int]) -> Any:
        """The disjoint graph of one sequence per entry."""

    def prepare(self, batch: Any) -> Any:
        """What the steps of one stretch share; gradients flow through it, so the next stretch needs another."""

    def step(self, batch: Any, state: SimState, force: Tensor | None = None, prepared: Any = None) -> Any:
        """Predicts the next frame of all members; ``prepared`` is made for this step alone when None."""

    def parameter_groups(self) -> dict[str, list[Parameter]]:
        """Trainable parameters: ``network`` (shared by all scenes), ``scene`` (densities, attributes), ``template``."""
