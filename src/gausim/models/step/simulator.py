"""GausSim: one step from x_{t-1}, x_t to x_{t+1}, coarse to fine (METHOD section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, GaussianScene, SimState, SteppedFrame
from gausim.models.hierarchy.batch import LevelBatch, SceneBatch
from gausim.models.hierarchy.units import FixedUnits, weighted_sum
from gausim.models.reference.reference import HandMotion, Placed, Reference, UnitMotion
from gausim.models.reference.surroundings import reference_of
from gausim.models.settings import HierarchySettings, RolloutSettings
from gausim.models.step.features import FeatureOptions
from gausim.models.step.head import Head
from gausim.models.step.predictor import DeformationPredictor
from gausim.models.step.prepared import Prepared
from gausim.models.step.recursion import Solved, Units, advance, inherit
from gausim.models.step.scene_model import SceneModel
from gausim.models.template.material import MaterialTemplate
from gausim.models.template.template import Motion, Template
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.normaliser import gathering_nothing, normalisers_of

DEFAULT_HIERARCHY, DEFAULT_FEATURES = HierarchySettings(), FeatureOptions()
DEFAULT_HEAD, DEFAULT_ROLLOUT = Head(), RolloutSettings()


@dataclass(frozen=True, eq=False)
class Step(SteppedFrame):
    """Result of a step: x_{t+1} of a batch, and deformation gradients G and rotations Q of its finest units."""

    # sum over levels and parents of ||m_c x_c - sum m_i x_i||^2, in masses and diagonals of the scene; zero without
    # conserve_momentum
    momentum: Float[Tensor, ""]
    predicted: tuple[Float[Tensor, "_ 3 3"], ...]  # F per predicted level, coarse to fine
    state: SimState | None = None  # where the next step starts, if an impact changed a velocity within the frame


class GausSim(SceneModel):
    """The simulator of one or several scenes that share one network."""

    def __init__(
        self,
        scenes: Sequence[GaussianScene],
        fps: Sequence[float],
        *,
        hierarchy: HierarchySettings = DEFAULT_HIERARCHY,
        features: FeatureOptions = DEFAULT_FEATURES,
        network: Callable[..., nn.Module] = MeshGraphNet,
        head: Head = DEFAULT_HEAD,
        template: Callable[..., Template] = MaterialTemplate,
        conserve_mass: bool = True,
        conserve_momentum: bool = True,
        rollout: RolloutSettings = DEFAULT_ROLLOUT,
    ) -> None:
        """Builds the hierarchies, the template and the predictor.

        Args:
            scenes: rest scenes, each with at least one pinned kernel.
            fps: frames per second of each scene's videos.
            hierarchy: settings of the units and their neighbours.
            features: choice of the network's input features.
            network: called with node_features=, edge_features= and outputs=.
            head: map from the network's output to deformation gradients.
            template: state that F deforms; called with (hierarchies, finest level, attributes=,
                frames= (axes of the scenes), conserve_volume=conserve_mass).
            conserve_mass: normalise to det F = 1.
            conserve_momentum: compute the momentum loss.
            rollout: CUDA graphs, and the energy guard of rollouts without loss gradients.

        Raises:
            ConfigError: not one frame rate per scene.
            SceneError: a scene has no pinned kernel, or no free one.
        """
        super().__init__(scenes, fps, hierarchy, features.attributes)
        self.conserve_momentum, self.rollout = conserve_momentum, rollout
        self.template = template(
            self.hierarchies, self.predicted_levels[-1], attributes=features.attributes, frames=self.body_axes,
            conserve_volume=conserve_mass,
        )  # fmt: skip
        self.shape_bodies(self.template.solid)
        self.predictor = DeformationPredictor(
            features=features.of(scenes), network=network, head=head, edges=hierarchy.edges, conserve_mass=conserve_mass,
        )  # fmt: skip

    def prepare(self, batch: SceneBatch, *, isolated: bool = False, driven: bool = False) -> Prepared:
        """Constants of the steps of this batch between two updates of the parameters.

        Loss gradients flow through them: prepare anew for every stretch of steps between two backward passes.
        ``isolated`` leaves out the surroundings: the body deforms about its rest state, which nothing moves. ``driven``
        lets the pins of scenes without recorded hands move, as one hand.
        """
        mass, fraction, levels = self.units(batch)
        top, rest = batch.levels[0], levels[-1].rest
        roots = batch.rest.index_select(0, batch.simulated.index_select(0, top.parent))
        frames = self.frames(batch)
        if frames is not None:
            levels = tuple(replace(level, rest=frames.into(i, level.rest)) for i, level in enumerate(levels))
            roots = frames.into(0, roots)
        template = self.template.prepare(batch, levels[-1])
        reference = Reference(batch)
        if not isolated:
            axes = None if frames is None else frames.axes[-1]
            units = replace(levels[-1], rest=rest)  # in scene axes
            reference = reference_of(self.surroundings, batch, mass, units, template, axes, driven=driven)
        prepared = Prepared(batch, mass, fraction, levels, Solved.roots(roots), template, frames, rest, None, reference)
        return replace(prepared, still=self._outputs_at_rest(prepared)) if self.predictor.head.anchor else prepared

    def step(
        self,
        batch: SceneBatch,
        state: SimState,
        force: Float[Tensor, "K 3"] | None = None,
        prepared: Prepared | None = None,
        correction_scale: float = 1.0,
        hands: Sequence[HandMotion | None] | None = None,
    ) -> Step:
        """Predicts the next frame.

        Args:
            batch: from :meth:`batch`.
            state: positions and previous positions of all kernels of the batch [scene units].
            force: force per kernel [mass scene units / s^2]; it displaces free kernels by f dt^2 / (2 m) before the
                step (METHOD section 6).
            prepared: from :meth:`prepare`, for all steps between two updates of the parameters; computed when None.
            correction_scale: factor on the network's output; 0 gives the step of the template alone.
            hands: poses of the hands of every member before, at and after this frame; None: all pins are at rest.
        """
        prepared = self.prepare(batch) if prepared is None else prepared
        if force is not None:
            state = self.pushed(prepared, state, force)
        carried, units = prepared.carried(state, hands)
        finest, template, momentum, predicted = self._descend(prepared, units, correction_scale, [])
        finest, template, predicted = prepared.in_scene_axes(finest, template, predicted)
        x, deformation, rotations, before = carried.place(Placed(*inherit(finest, template, batch)))
        after = None if before is None else SimState(x, before)
        return Step(x, deformation, rotations, momentum, tuple(predicted), after)

    def _descend(
        self, prepared: Prepared, units: UnitMotion, correction_scale: float, outputs: list[Tensor]
    ) -> tuple[Solved, Tensor | None, Tensor, list[Tensor]]:
        """Solves the predicted levels, coarse to fine: returns the finest one, the template's P, momentum and all F.

        The network's outputs, before those at rest are subtracted, are appended to ``outputs``.
        """
        # The template predicts the finest units; coarser ones are their centres of mass, at all three times.
        rest = prepared.levels[-1].rest
        seen = prepared.template.carried(Motion(rest, units.now, units.before))
        template = prepared.template(seen, units.load)
        now = self.predictor.features.positions(seen.before, seen.now, template.positions)
        states = [prepared.per_level(x) for x in (now, seen.before, template.positions)]
        above, momentum, predicted = prepared.roots, rest.new_zeros(()), []
        unit_of_correction = prepared.template.correction_unit()
        for position, (level, fixed, x, previous, target, floor) in enumerate(
            zip(prepared.batch.levels, prepared.levels, *states, prepared.floors(units), strict=True)
        ):
            if position:
                above = replace(above, index=level.parent)
            unit = Units(fixed.rest, x, previous, fixed.mass, fixed.log_density, fixed.attributes, floor)
            output = self.predictor(level, unit, above, target, position)
            outputs.append(output)
            moved = output if prepared.still is None else output - prepared.still[position]
            scale = correction_scale * level.free
            if unit_of_correction is not None:
                scale = scale * unit_of_correction.index_select(0, level.member)[:, None]
            deformation_gradient, rotation = self.predictor.deformation_gradient(moved * scale, level, above, target)
            predicted.append(deformation_gradient)
            accumulated, turned, after = advance(deformation_gradient, rotation, target, above)
            if position and self.conserve_momentum:
                momentum = momentum + _momentum(level, unit, after, above.after, prepared.levels[position - 1])
            above = Solved(unit.rest, x, previous, after, target, accumulated, turned, above.index)
        return above, template.deformation_gradients, momentum, predicted

    def _outputs_at_rest(self, prepared: Prepared) -> tuple[Tensor, ...]:
        """The network's output for every unit of every predicted level at rest."""
        rest = prepared.levels[-1].rest
        outputs: list[Tensor] = []
        with gathering_nothing(normalisers_of(self.predictor)):
            self._descend(prepared, UnitMotion(rest, rest, None), 0.0, outputs)
        return tuple(outputs)


def _momentum(level: LevelBatch, unit: Units, after: Tensor, parents: Tensor, above: FixedUnits) -> Tensor:
    """sum_c ||m_c x_c - sum_{i in c} m_i x_i||^2 over the parents c, in masses and diagonals of the scene."""
    weighted = weighted_sum(after, unit.mass, level.parent, len(parents))
    return ((above.mass[:, None] * parents - weighted) / above.scale).square().sum()
