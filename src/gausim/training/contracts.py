"""Interface of a trainable simulator: steps over a disjoint graph of several sequences."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Tensor
from torch.nn import Parameter

from gausim.core import GaussianScene, SimState


@runtime_checkable
class SceneBatch(Protocol):
    """Several sequences, also of different scenes, as one disjoint graph."""

    rest: Tensor  # (K over all members, 3) rest positions [scene units]
    # the sequences, in the requested order. Each has a ``scene_id``, slices ``kernels`` of the positions and
    # ``units`` of the deformation gradients and rotations, and the unit of each of its kernels, counted within
    # ``units`` (``unit_of_kernel``)
    members: tuple[Any, ...]


@runtime_checkable
class Simulator(Protocol):
    """Dynamics of a batch of sequences, as a torch module.

    Training uses these members of :class:`gausim.models.step.scene_model.SceneModel` where a model has them: the units
    of its kernels (``units_of_kernels``).
    """

    scenes: Sequence[GaussianScene]  # the rest scenes; their index is the ``scene_id`` of samples

    def batch(self, scene_ids: Sequence[int]) -> Any:
        """The disjoint graph of one sequence per entry."""

    def prepare(self, batch: Any, **options: Any) -> Any:
        """Quantities common to the steps of one stretch; part of its graph, so each stretch computes its own.

        ``options`` is ``isolated=True`` where a step from rest leaves out the surroundings.
        """

    def step(
        self, batch: Any, state: SimState, force: Tensor | None = None, prepared: Any = None, **options: Any
    ) -> Any:
        """Predicts the next frame of all members; without ``prepared`` it is computed for this step alone.

        ``options`` are the members' ``hands``, for a simulator of bodies in hands.
        """

    def parameter_groups(self) -> dict[str, list[Parameter]]:
        """Trainable parameters: ``network`` (shared by all scenes), ``scene`` (densities, attributes), ``template``."""
