"""Base of simulators: the scenes' units and parameters, without the step."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.core import ConfigError, GaussianScene, SimState, SmoothMotions
from gausim.models.hierarchy.batch import BatchBuilder, SceneBatch
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.hierarchy.units import FixedUnits, UnitMotion, fixed_units
from gausim.models.reference.surroundings import SceneSurroundings
from gausim.models.settings import HierarchySettings
from gausim.models.step.body_frame import Frames, body_axes
from gausim.models.step.predictor import DeformationPredictor
from gausim.models.step.prepared import Prepared
from gausim.models.template.modal import ModalScene
from gausim.models.template.solid import SolidSettings
from gausim.models.template.template import PreparedScenes, Property, Template, local_means
from gausim.nn.normaliser import normalisers_of

# Disjoint unions that stay in memory; with many scenes almost every batch is another one.
MOST_BATCHES = 256
# Deviation of the Gaussian that maps of learned material are averaged with [diagonals].
MAP_WIDTH = 0.15


class SceneModel(nn.Module, ABC):
    """Scenes, their hierarchies, densities and attributes; a subclass adds the template, the predictor and a step.

    Attributes:
        scenes: the rest scenes.
        fps: frames per second of each scene.
        hierarchies: the hierarchy of units of each scene.
        predicted_levels: indices of the predicted levels, coarse to fine.
    """

    axes: Tensor
    origins: Tensor
    template: Template
    predictor: DeformationPredictor

    def __init__(
        self, scenes: Sequence[GaussianScene], fps: Sequence[float], settings: HierarchySettings, attributes: int
    ) -> None:
        """Builds the units.

        Raises:
            ConfigError: no scene, or not one frame rate per scene.
            SceneError: a scene has no pinned kernel, or no free one.
        """
        super().__init__()
        if not scenes or len(scenes) != len(fps):
            raise ConfigError(
                f"{len(scenes)} scenes and {len(fps)} frame rates given; expected one rate per scene, at least one."
            )
        self.scenes, self.fps = tuple(scenes), tuple(fps)
        self.predicted_levels = settings.predicted
        self.body_axes = [body_axes(s) if settings.body_frame else np.eye(3) for s in scenes]
        self.hierarchies = tuple(
            build_hierarchy(
                scene, radii=settings.diameters, axes=own if settings.body_frame else None,
            )
            for scene, own in zip(scenes, self.body_axes, strict=True)
        )  # fmt: skip
        self._builder = BatchBuilder(self.scenes, self.hierarchies, self.fps, settings)
        self._batches: dict[tuple[tuple[int, ...], torch.device], SceneBatch] = {}
        origins = [s.means.mean(0) if settings.body_frame else torch.zeros(3) for s in scenes]
        self.register_buffer("axes", torch.from_numpy(np.stack(self.body_axes)).to(scenes[0].means), persistent=False)
        self.register_buffer("origins", torch.stack(origins).to(scenes[0].means), persistent=False)
        counts = [h.levels[0].count for h in self.hierarchies]
        self.surroundings = nn.ModuleList(
            SceneSurroundings(scene, hierarchy, self.predicted_levels[-1], rate)
            for scene, hierarchy, rate in zip(scenes, self.hierarchies, fps, strict=True)
        )
        self.log_density = nn.ParameterList(torch.zeros(n) for n in counts)
        self.attributes = nn.ParameterList(torch.zeros(n, attributes) for n in counts)

    @abstractmethod
    def prepare(self, batch: SceneBatch, *, isolated: bool = False, driven: bool = False) -> Prepared:
        """Constants of the steps of this batch between two updates of the parameters."""

    def batch(self, scene_ids: Sequence[int]) -> SceneBatch:
        """The disjoint union of one sequence per entry of ``scene_ids`` (cached)."""
        device = self.log_density[0].device
        key = (tuple(scene_ids), device)
        if key not in self._batches:
            if len(self._batches) >= MOST_BATCHES:
                self._batches.pop(next(iter(self._batches)))
            self._batches[key] = self._builder.build(key[0], device)
        return self._batches[key]

    def shape_bodies(self, solid: SolidSettings) -> None:
        """Says of which solids the static shapes of bodies in hands are."""
        for own in self.surroundings:
            cast(SceneSurroundings, own).solid = solid

    def frames(self, batch: SceneBatch) -> Frames:
        """The axes of every unit of a batch: those of its body, or of the scene."""
        return Frames.of(batch, self.axes, self.origins)

    def units_of_kernels(self, scene_id: int) -> tuple[Int[Tensor, " K"], ...]:
        """The unit of every kernel of the scene at levels 1..L; -1 for kernels that are never simulated."""
        hierarchy, count = self.hierarchies[scene_id], self.scenes[scene_id].count
        none = torch.full((count,), -1)
        levels = range(1, len(hierarchy.levels))
        return tuple(none.index_copy(0, hierarchy.kernels, hierarchy.ancestor(0, level)) for level in levels)

    def masses(self, batch: SceneBatch) -> tuple[Float[Tensor, " M"], Float[Tensor, " M"]]:
        """Masses m = exp(r) V of the simulated kernels, and their log density r."""
        log_density = torch.cat([self.log_density[i] for i in batch.scene_ids])
        return log_density.exp() * batch.volume, log_density

    def units(self, batch: SceneBatch) -> tuple[Float[Tensor, " M"], Float[Tensor, " K"], tuple[FixedUnits, ...]]:
        """Masses of the simulated kernels, and what :func:`gausim.models.hierarchy.units.fixed_units` makes of them."""
        mass, _ = self.masses(batch)
        attributes = torch.cat([self.attributes[i] for i in batch.scene_ids])
        return mass, *fixed_units(batch, mass, attributes)

    def modal_scene(self, scene_id: int) -> ModalScene:
        """The template of one scene in modal coordinates, between two updates of the parameters.

        Raises:
            ConfigError: the template has no modes.
        """
        batch = self.batch((scene_id,))
        template = self.template.prepare(batch, self.units(batch)[-1][-1])
        if not isinstance(template, PreparedScenes):
            raise ConfigError(f"model.simulator.template: {type(self.template).__name__} has no modes.")
        return template.parts[0][0]

    @torch.no_grad()
    def modal_projection(self, scene_id: int) -> Float[Tensor, "K 3 M"]:
        """P with z = sum_k u_k P_k, the modal coordinates of displacements u of the kernels of a scene."""
        batch = self.batch((scene_id,))
        _, fraction, _ = self.units(batch)
        projection = self.modal_scene(scene_id).projection.unflatten(0, (-1, 3))
        projection = self.frames(batch).axes[-1].mT @ projection
        return fraction[:, None, None] * projection.index_select(0, batch.finest)

    def pushed(self, prepared: Prepared, state: SimState, force: Float[Tensor, "K 3"]) -> SimState:
        """The state after a force on free kernels has acted on it for a frame.

        The paper's is x_t + f dt^2 / (2 m). In templates with modes x_{t-1} gives the same velocity, f dt / m, less
        what its frame does not reach (:meth:`gausim.models.template.modal.ModalScene.overshoot`).
        """
        shift = force * prepared.yielding
        if not self.knows_energy:
            return replace(state, positions=state.positions + shift)
        gained = torch.where(prepared.yielding > 0, 2 * shift - prepared.overshoot(state, 2 * shift), 0.0)
        return replace(state, previous=state.previous - gained)

    @property
    def knows_energy(self) -> bool:
        """Whether the template has an energy."""
        return self.template.has_energy

    def energy(self, batch: SceneBatch, state: SimState, prepared: Prepared | None = None) -> Float[Tensor, " S"]:
        """Energy of every member of the batch in the template's terms, up to a factor per scene.

        Raises:
            NotImplementedError: the template has none.
        """
        prepared = self.prepare(batch) if prepared is None else prepared
        return prepared.template.energy(_finest(prepared, state))

    def dissipated(self, prepared: Prepared, after: SimState, previous: Float[Tensor, "K 3"]) -> Float[Tensor, " S"]:
        """Energy that the template's damping takes in a step that ends with ``after`` and began at x_{t-1}."""
        return prepared.template.dissipated(_finest(prepared, after), prepared.finest(previous))

    def smooth_motions(self, scene_id: int) -> SmoothMotions:
        """The template's modes at every kernel of a scene.

        A kernel moves by the displacement of its unit plus the unit's displacement gradient times its offset.
        """
        motions = self.template.basis(scene_id)
        scene, hierarchy, finest = self.scenes[scene_id], self.hierarchies[scene_id], self.predicted_levels[-1]
        modes, slopes, sizes = (x.to(scene.means) for x in motions)  # where the scenes are
        axes = self.axes[scene_id].to(modes)
        modes = torch.einsum("ba,nbm->nam", axes, modes)
        slopes = torch.einsum("ca,ncdm,db->nabm", axes, slopes, axes)
        unit = hierarchy.ancestor(0, finest)
        offset = scene.means[hierarchy.kernels] - hierarchy.levels[finest].rest[unit]
        moved = modes[unit] + torch.einsum("kabm,kb->kam", slopes[unit], offset)
        kernels = moved.new_zeros(scene.count, 3, modes.shape[-1])
        kernels[hierarchy.kernels] = moved * ~hierarchy.levels[0].pinned[:, None, None]
        rows, still = torch.cat((slopes, torch.zeros_like(slopes[:1]))), torch.full((scene.count,), len(modes))
        return SmoothMotions(kernels, rows, still.index_copy(0, hierarchy.kernels, unit), sizes)

    @torch.no_grad()
    def material_of_units(self, scene_id: int) -> dict[str, Property]:
        """Learned properties of the finest predicted units by name, averaged over their surroundings.

        The values of single units also make up for what the template does not know of a body: only what is left at
        :data:`MAP_WIDTH` is read as its material.
        """
        batch = self.batch((scene_id,))
        finest = self.units(batch)[-1][-1]
        properties, free = self.template.material(scene_id, finest, self.fps[scene_id]), ~batch.levels[-1].pinned
        width = MAP_WIDTH * self.scenes[scene_id].diagonal
        return {
            name: Property(local_means(learned.values, finest.rest.to(learned.values), free, width), learned.text)
            for name, learned in properties.items()
        }

    @torch.no_grad()
    def material(self, scene_id: int) -> dict[str, Property]:
        """Learned properties of the scene's kernels: ``density``, and ``stiffness`` and ``damping`` if it knows them.

        Each kernel has the value of its finest predicted unit (:meth:`material_of_units`); NaN for kernels that never
        move.
        """
        batch, scene, properties = self.batch((scene_id,)), self.scenes[scene_id], self.material_of_units(scene_id)

        def of_kernels(values: Tensor) -> Tensor:
            every = torch.full((scene.count,), torch.nan)
            every[batch.simulated.cpu()] = values[batch.levels[-1].unit_of_kernel].float().cpu()
            return torch.where(scene.simulated.cpu() & ~scene.pinned.cpu(), every, torch.nan)

        return {name: Property(of_kernels(learned.values), learned.text) for name, learned in properties.items()}

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by role: the network, densities and attributes, and the template's, shared or of scenes."""
        named, shared = dict(self.template.named_parameters()), self.template.shared("")
        return {
            "network": list(self.predictor.parameters()),
            "scene": [*self.log_density, *self.attributes, *self.surroundings.parameters()],
            "template": [p for name, p in named.items() if name.startswith(shared)],
            "matrices": [p for name, p in named.items() if not name.startswith(shared)],
        }

    def shared(self) -> tuple[str, ...]:
        """Prefixes of the names of what all scenes have in common: predictor, statistics of its inputs, decoders."""
        return "predictor.", *self.template.shared("template.")

    def own(self, scene_id: int) -> tuple[str, ...]:
        """Prefixes of the names of a scene's parameters and buffers in the state dict."""
        own = f"log_density.{scene_id}", f"attributes.{scene_id}", f"surroundings.{scene_id}."
        return *own, *self.template.own(scene_id, "template.")

    def freeze(self, *, scenes: bool = False) -> None:
        """Freezes what :meth:`shared` names: weights, and the statistics of the normalisers.

        Args:
            scenes: also freeze the parameters of the scenes.
        """
        for name, parameter in self.named_parameters():
            if scenes or name.startswith(self.shared()):
                parameter.requires_grad_(False)
        for normaliser in normalisers_of(self.predictor):
            normaliser.frozen = True


def _finest(prepared: Prepared, state: SimState) -> UnitMotion:
    now, before = prepared.finest(state.positions), prepared.finest(state.previous)
    return UnitMotion(prepared.levels[-1].rest, now, before)
