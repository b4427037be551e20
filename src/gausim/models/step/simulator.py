"""GausSim: one step from x_{t-1}, x_t to x_{t+1}, coarse to fine (METHOD section 2)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, Frame, GaussianScene, SimState
from gausim.models.hierarchy.batch import LevelBatch, SceneBatch
from gausim.models.hierarchy.units import FixedUnits, UnitMotion, weighted_sum
from gausim.models.reference.reference import HandMotion, Reference
from gausim.models.reference.surroundings import reference_of
from gausim.models.settings import HierarchySettings, RolloutSettings
from gausim.models.step.features import FeatureOptions
from gausim.models.step.head import Head
from gausim.models.step.predictor import DeformationPredictor
from gausim.models.step.prepared import Prepared
from gausim.models.step.recursion import Solved, Units, advance, inherit
from gausim.models.step.scene_model import SceneModel
from gausim.models.template.material import MaterialTemplate
from gausim.models.template.template import RestTemplate, Template
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.normaliser import gathering_nothing, normalisers_of

DEFAULT_HIERARCHY, DEFAULT_FEATURES = HierarchySettings(), FeatureOptions()
DEFAULT_HEAD, DEFAULT_ROLLOUT = Head(), RolloutSettings()


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
        template: Callable[..., Template] | None = MaterialTemplate,
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
            template: state that F deforms, None: the rest state; called with (hierarchies, finest level, attributes=,
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
        self.template = (template or RestTemplate)(
            self.hierarchies, self.predicted_levels[-1], attributes=features.attributes, frames=self.body_axes,
            conserve_volume=conserve_mass,
        )  # fmt: skip
        self.shape_bodies(self.template.solid)
        self.history = features.history
        if self.history and not all(scene.surroundings.still for scene in scenes):
            raise ConfigError(
                "model.simulator.features.history: expected 0 where bodies are free or in hands. Set it to 0."
            )
        self.predictor = DeformationPredictor(
            features=features.of(scenes), network=network, head=head, edges=hierarchy.edges,
            conserve_mass=conserve_mass,
        )  # fmt: skip

    def prepare(self, batch: SceneBatch, *, isolated: bool = False, driven: bool = False) -> Prepared:
        """Constants of the steps of this batch between two updates of the parameters.

        Loss gradients flow through them: prepare anew for every stretch of steps between two backward passes.
        ``isolated`` leaves out the surroundings: the body deforms about its rest state, which nothing moves. ``driven``
        lets the pins of scenes without recorded hands move, as one hand.
        """
        mass, fraction, levels = self.units(batch)
        top, units, frames = batch.levels[0], levels[-1], self.frames(batch)
        roots = batch.rest.index_select(0, batch.simulated.index_select(0, top.parent))
        levels = tuple(replace(level, rest=frames.into(i, level.rest)) for i, level in enumerate(levels))
        template, reference = self.template.prepare(batch, levels[-1]), Reference(batch, units.rest)
        if not isolated:
            reference = reference_of(
                self.surroundings, batch, mass, units, template, frames.axes[-1], driven=driven
            )  # fmt: skip
        none = (batch.rest.new_zeros(()),) * len(levels)
        prepared = Prepared(
            batch, mass, fraction, levels, Solved.roots(frames.into(0, roots)), template, frames, units.rest, none,
            reference,
        )  # fmt: skip
        return self._anchored(prepared) if self.predictor.head.anchor else prepared

    def step(
        self,
        batch: SceneBatch,
        state: SimState,
        force: Float[Tensor, "K 3"] | None = None,
        prepared: Prepared | None = None,
        correction_scale: float = 1.0,
        hands: Sequence[HandMotion | None] | None = None,
    ) -> Frame:
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
        began = state.positions
        state = state if force is None else self.pushed(prepared, state, force)
        # Kernels are aggregated to centres of mass of the finest units, relative to the reference that carries them.
        state = state.remembering(self.history)
        carried, motion = prepared.aggregate(state, hands)
        # The levels are solved coarse to fine. Zero output of the network leaves the template as it is.
        finest, template, momentum, predicted = self._solve(prepared, motion, correction_scale, [])
        finest, template, gradients = prepared.in_scene_axes(finest, template, predicted)
        # Kernels inherit the motion and the deformation of their finest unit, and go back to the scene.
        frame = replace(inherit(finest, template, batch), momentum=momentum, predicted=gradients)
        frame = carried.place(frame)
        if not self.history:
            return frame
        older = (state.previous, *state.older)[: self.history]
        return replace(frame, state=SimState(frame.positions, began, older))

    def _solve(
        self, prepared: Prepared, motion: UnitMotion, correction_scale: float, outputs: list[Tensor]
    ) -> tuple[Solved, Tensor | None, Tensor, list[Tensor]]:
        """Solves the predicted levels, coarse to fine: returns the finest one, the template's P, momentum and all F.

        The network's outputs, before those at rest are subtracted, are appended to ``outputs``.
        """
        # The template predicts the finest units from what its modes carry of their motion. Coarser units are their
        # centres of mass, at all three times.
        motion = prepared.template.carried(motion)
        targets, gradients = prepared.template(motion)
        now = self.predictor.features.positions(motion.before, motion.now, targets)
        states = [prepared.per_level(x) for x in (now, motion.before, targets)]
        older = [prepared.per_level(x) for x in motion.older]
        above, momentum, predicted = prepared.roots, targets.new_zeros(()), []
        unit_of_correction = prepared.template.correction_unit()
        for position, (level, fixed, x, before, target, floor) in enumerate(
            zip(prepared.batch.levels, prepared.levels, *states, prepared.floors(motion), strict=True)
        ):
            above = replace(above, index=level.parent) if position else above
            past = tuple(x[position] for x in older)
            unit = Units(fixed.rest, x, before, fixed.mass, fixed.log_density, fixed.attributes, floor, past)
            # Inputs from the unit, its parent and its neighbours. The output at rest is subtracted.
            output = self.predictor(level, unit, above, target, position)
            outputs.append(output)
            scale = correction_scale * _scale(level, unit_of_correction)
            output = (output - prepared.rest_outputs[position]) * scale
            # F of the unit about its parent, with det F = 1 where mass is conserved.
            deformation_gradient, rotation = self.predictor.deformation_gradient(output, level, above, target)
            predicted.append(deformation_gradient)
            # x = x_p + C (T - T_p) with C = F C_p.
            accumulated, turned, after = advance(deformation_gradient, rotation, target, above)
            # The centre of mass of a parent's children is to stay where the parent is.
            if position and self.conserve_momentum:
                momentum = momentum + _momentum(level, unit, after, above.after, prepared.levels[position - 1])
            above = Solved(unit.rest, x, before, after, target, accumulated, turned, above.index)
        return above, gradients, momentum, predicted

    def _anchored(self, prepared: Prepared) -> Prepared:
        """With the network's outputs for all units at rest, so that rest is an equilibrium."""
        rest = prepared.levels[-1].rest
        outputs: list[Tensor] = []
        with gathering_nothing(normalisers_of(self.predictor)):
            still = UnitMotion(rest, rest, rest, older=(rest,) * self.history)
            self._solve(prepared, still, 0.0, outputs)
        return replace(prepared, rest_outputs=tuple(outputs))


def _scale(level: LevelBatch, unit: Float[Tensor, " S"] | None) -> Float[Tensor, "N 1"]:
    """Factor on the output of every unit: 0 for pinned ones, else its member's unit of corrections."""
    return level.free if unit is None else level.free * unit.index_select(0, level.member)[:, None]


def _momentum(level: LevelBatch, unit: Units, after: Tensor, parents: Tensor, above: FixedUnits) -> Tensor:
    """sum_c ||m_c x_c - sum_{i in c} m_i x_i||^2 over the parents c, in masses and diagonals of the scene."""
    weighted = weighted_sum(after, unit.mass, level.parent, len(parents))
    return ((above.mass[:, None] * parents - weighted) / above.scale).square().sum()
