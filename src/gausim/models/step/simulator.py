"""GausSim: one step from x_{t-1}, x_t to x_{t+1}, coarse to fine (METHOD section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gausim.core import ConfigError, GaussianScene, SimState, SmoothMotions
from gausim.kernels.announce import announced
from gausim.models.hierarchy.batch import BatchBuilder, GraphOptions, LevelBatch, SceneBatch
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.hierarchy.edges import EdgeSet, fill, fill_edges
from gausim.models.hierarchy.units import FixedUnits, fixed_units
from gausim.models.step.body_frame import Frames, body_axes
from gausim.models.step.features import FeatureOptions, network_inputs
from gausim.models.step.head import lever_gradient
from gausim.models.step.prepared import Prepared
from gausim.models.step.recursion import Solved, Units, advance, inherit
from gausim.models.template.smooth import smooth_motions
from gausim.models.template.template import Motion, PreparedScenes, RestTemplate, Template
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.mlp import zero_output as initialise_zero
from gausim.nn.normaliser import RunningNormaliser, gathering_nothing
from gausim.ops.aggregation import weighted_sum
from gausim.ops.deformation import gradient_from_output

ANGLES = ("cos_sin", "inner")


@dataclass(frozen=True, eq=False)
class Step:
    """What a step gives.

    Attributes:
        positions: x_{t+1} of all kernels of the batch [scene units].
        gradients: accumulated deformation gradients of the finest predicted units, per member plus its identity unit.
        rotations: their accumulated rotations.
        momentum: sum over levels and parents of ||m_c x_c - sum m_i x_i||^2, masses over that of the scene and lengths
            over its diagonal; zero where it is switched off.
        predicted: the network's own gradients F, per predicted level, coarse to fine.
    """

    positions: Float[Tensor, "K 3"]
    gradients: Float[Tensor, "N 3 3"]
    rotations: Float[Tensor, "N 3 3"]
    momentum: Float[Tensor, ""]
    predicted: tuple[Float[Tensor, "_ 3 3"], ...]


class GausSim(nn.Module):
    """The simulator of one or several scenes that share one network."""

    gravity: Tensor
    axes: Tensor
    origins: Tensor

    def __init__(
        self,
        scenes: Sequence[GaussianScene],
        fps: Sequence[float],
        *,
        radii: Sequence[float] = (0.1, 0.35),
        predicted_levels: Sequence[int] = (2, 1),
        clustering: str = "agglomerative",
        graph_radii: Sequence[float] = (2.0, 0.4),
        max_neighbours: int = 16,
        edges: str = "union",
        angle: str = "cos_sin",
        rest_inputs: bool = False,
        coarse_inputs: bool = False,
        attributes: int = 4,
        hidden: int = 128,
        layers: int = 16,
        norm: str = "pre",
        activation: str = "silu",
        share_levels: bool = True,
        precision: str = "fp32",
        checkpoint: bool = False,
        compile: bool = False,
        edge_bucket: int = 0,
        output_scale: float = 1.0,
        zero_output: bool = False,
        conserve_mass: bool = True,
        conserve_momentum: bool = True,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        normaliser_floor: float = 1e-2,
        cuda_graph: bool = False,
        passive_frames: int = 0,
        velocity_inputs: bool = True,
        lever_head: float = 0.0,
        anchor: bool = False,
        body_frame: bool = False,
        template: Callable[..., Template] = RestTemplate,
    ) -> None:
        """Builds hierarchies, graph and network.

        Args:
            scenes: rest scenes, each with at least one pinned kernel.
            fps: frames per second of each scene's videos.
            radii: cluster diameters of levels 1..L [fractions of the diagonal].
            predicted_levels: levels whose gradients the network predicts, coarse to fine; [0] is "without hierarchy".
            clustering: as in :func:`gausim.models.hierarchy.clusters.build_hierarchy`.
            graph_radii: edge lengths per predicted level, same order [fractions of the diagonal].
            max_neighbours: edges per unit.
            edges: neighbours in ``rest`` space, in the ``current`` state, or the ``union`` / ``intersection`` of both.
            angle: ``cos_sin`` or ``inner`` (relative angle of an edge).
            rest_inputs: also give displacements and rest-space edge vectors to the network.
            coarse_inputs: read positions below the top level from the coarse prediction.
            attributes: material attributes per kernel.
            hidden: width of the network.
            layers: message-passing layers.
            norm: LayerNorm ``pre`` or ``post`` in them.
            activation: ``silu`` or ``relu``.
            share_levels: one network serves every predicted level; else each has its own (normalisers are shared).
            precision: ``fp32`` or ``bf16`` products in the network's layers.
            checkpoint: the network keeps little for the backward pass and computes the rest once more.
            compile: compile the network's layers at the first step.
            edge_bucket: fill the edges of a level up to a multiple of this with edges of a dummy node, so that their
                number seldom changes; 0 does not. In evaluation mode on CUDA it never changes.
            output_scale: factor on the network's raw output.
            zero_output: start with zero output (identity gradients).
            conserve_mass: det F = 1.
            conserve_momentum: compute the momentum loss.
            gravity: acceleration [scene units / s^2].
            normaliser_floor: smallest standard deviation of a normalised input.
            cuda_graph: rollouts on a CUDA device replay the step as one graph; of no effect elsewhere.
            passive_frames: in rollouts, the network may not raise the template's energy beyond the largest of so many
                frames before (:class:`~gausim.models.rollout.energy_guard.EnergyGuard`); 0, or a template
                without energy: no limit.
            velocity_inputs: give velocities and accelerations to the network. Without them it sees positions and, of
                every unit, the lever X_i - X_p from its parent: the step is the same forwards and backwards in time.
            lever_head: three more outputs per unit move its lever by so many diagonals each, see
                :func:`gausim.models.step.head.lever_gradient`; 0 leaves them out.
            anchor: take the network's outputs at rest off, so that rest is an equilibrium.
            body_frame: work in the body's own axes, so that a scene that is turned or moved moves likewise.
            template: what the gradients deform; called with (hierarchies, finest level, attributes=,
                frames= (axes of the scenes), conserve_volume=conserve_mass).
        """
        super().__init__()
        _check(predicted_levels, radii, graph_radii, angle, scenes, fps)
        if body_frame and any(gravity):
            raise ConfigError(
                "model.gravity is a direction of the scene: set model.simulator.body_frame=false with it."
            )
        self.scenes, self.fps = tuple(scenes), tuple(fps)
        self.predicted_levels = tuple(predicted_levels)
        self.edges, self.output_scale = EdgeSet(edges, edge_bucket), output_scale
        self.conserve_mass, self.conserve_momentum = conserve_mass, conserve_momentum
        self.cuda_graph, self.passive_frames = cuda_graph, passive_frames
        self.options = FeatureOptions(angle, rest_inputs, coarse_inputs, velocities=velocity_inputs)
        self.lever_head, self.anchor, self.body_frame = lever_head, anchor, body_frame
        axes = [body_axes(s) if body_frame else np.eye(3) for s in scenes]
        self.hierarchies = tuple(
            build_hierarchy(s, radii=radii, clustering=clustering, axes=own if body_frame else None)
            for s, own in zip(scenes, axes, strict=True)
        )
        graph = GraphOptions(tuple(graph_radii), max_neighbours)
        self._builder = BatchBuilder(self.scenes, self.hierarchies, self.fps, self.predicted_levels, graph)
        self._batches: dict[tuple[tuple[int, ...], torch.device], SceneBatch] = {}
        self.register_buffer("gravity", torch.tensor([float(g) for g in gravity]), persistent=False)
        origins = [s.means.mean(0) if body_frame else torch.zeros(3) for s in scenes]
        self.register_buffer("axes", torch.from_numpy(np.stack(axes)).to(scenes[0].means), persistent=False)
        self.register_buffer("origins", torch.stack(origins).to(scenes[0].means), persistent=False)
        self.template: Template = template(
            self.hierarchies,
            self.predicted_levels[-1],
            attributes=attributes,
            frames=axes,
            conserve_volume=conserve_mass,
        )
        counts = [h.levels[0].count for h in self.hierarchies]
        self.log_density = nn.ParameterList(torch.zeros(n) for n in counts)
        self.attributes = nn.ParameterList(torch.zeros(n, attributes) for n in counts)
        self.node_normaliser = RunningNormaliser(self.options.node_normalised, floor=normaliser_floor)
        self.edge_normaliser = RunningNormaliser(self.options.edge_normalised, floor=normaliser_floor)
        networks = [
            MeshGraphNet(
                node_features=self.options.node_normalised + 1 + attributes,
                edge_features=self.options.edge_size,
                outputs=14 if lever_head else 11,
                hidden=hidden,
                layers=layers,
                norm=norm,
                activation=activation,
                precision=precision,
                checkpoint=checkpoint,
                compile=compile,
            )
            for _ in (self.predicted_levels[:1] if share_levels else self.predicted_levels)
        ]
        for network in networks if zero_output else ():
            initialise_zero(network.decoder)
        self.network: nn.Module = networks[0] if share_levels else nn.ModuleList(networks)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by role: networks, per-scene densities and attributes, and the rest of the template."""
        networks = self.template.networks()
        known = {id(p) for p in networks}
        return {
            "network": [*self.network.parameters(), *networks],
            "scene": [*self.log_density, *self.attributes],
            "template": [p for p in self.template.parameters() if id(p) not in known],
        }

    def shared(self) -> dict[str, nn.Module]:
        """What all scenes have in common, by name: the network, the normalisers of its inputs, a shared template."""
        names = ["network", "node_normaliser", "edge_normaliser", *(["template"] if self.template.is_shared else [])]
        return {name: self.get_submodule(name) for name in names}

    def own(self, scene_id: int) -> tuple[str, ...]:
        """What a scene has of its own: prefixes of names in the state dict."""
        return f"log_density.{scene_id}", f"attributes.{scene_id}", *self.template.own(scene_id, "template.")

    def freeze(self, *, scenes: bool = False) -> None:
        """Keeps what :meth:`shared` names as it is: its weights do not learn, its statistics gather nothing more.

        Args:
            scenes: keep what the scenes have of their own, too.
        """
        for module in (self,) if scenes else self.shared().values():
            module.requires_grad_(False)
        self.node_normaliser.frozen = self.edge_normaliser.frozen = True

    def batch(self, scene_ids: Sequence[int]) -> SceneBatch:
        """The disjoint union for one sequence of each of these scenes (cached)."""
        device = self.log_density[0].device
        key = (tuple(scene_ids), device)
        if key not in self._batches:
            self._batches[key] = self._builder.build(key[0], device)
        return self._batches[key]

    def units_of_kernels(self, scene_id: int) -> tuple[Int[Tensor, " K"], ...]:
        """The unit of every kernel of the scene at levels 1..L; -1 for kernels that are never simulated."""
        hierarchy, count = self.hierarchies[scene_id], self.scenes[scene_id].count
        none = torch.full((count,), -1)
        levels = range(1, len(hierarchy.levels))
        return tuple(none.index_copy(0, hierarchy.kernels, hierarchy.ancestor(0, level)) for level in levels)

    def smooth_motions(self, scene_id: int) -> SmoothMotions | None:
        """The motions of a scene that the template can carry; None where it carries none."""
        motions = self.template.basis(scene_id)
        if motions is None:
            return None
        modes, gradients, sizes = motions
        axes = self.axes[scene_id].to(modes)
        modes = torch.einsum("ba,nbm->nam", axes, modes)
        gradients = torch.einsum("ca,ncdm,db->nabm", axes, gradients, axes)
        own = modes, gradients, sizes
        return smooth_motions(self.scenes[scene_id], self.hierarchies[scene_id], self.predicted_levels[-1], own)

    def mixing(self, scene_id: int) -> Float[Tensor, ""] | None:
        """How far the template has left the body of a scene; None where it learns no body."""
        return self.template.mixing(scene_id)

    def masses(self, batch: SceneBatch) -> tuple[Float[Tensor, " M"], Float[Tensor, " M"]]:
        """Masses m = exp(r) V of the simulated kernels, and r."""
        log_density = torch.cat([self.log_density[i] for i in batch.scene_ids])
        return log_density.exp() * batch.volume, log_density

    @property
    def knows_energy(self) -> bool:
        """Whether the template has an energy."""
        return self.template.has_energy

    def energy(self, batch: SceneBatch, state: SimState, prepared: Prepared | None = None) -> Float[Tensor, " S"]:
        """Energy of every member of the batch in the template's terms, up to a factor per scene."""
        prepared = self.prepare(batch) if prepared is None else prepared
        now, before = (prepared.units(x)[-1] for x in (state.positions, state.previous))
        if not isinstance(prepared.template, PreparedScenes):
            raise NotImplementedError(f"{type(self.template).__name__} has no energy")
        return prepared.template.energy(Motion(prepared.levels[-1].rest, now, before))

    def prepare(self, batch: SceneBatch) -> Prepared:
        """What steps of this batch have in common as long as no parameter changes.

        Gradients flow through it: make one for every stretch of steps with a backward pass of its own.
        """
        mass, _ = self.masses(batch)
        attributes = torch.cat([self.attributes[i] for i in batch.scene_ids])
        share, levels = fixed_units(batch, mass, attributes)
        top, rest = batch.levels[0], levels[-1].rest
        roots = batch.rest.index_select(0, batch.simulated.index_select(0, top.parent))
        frames = Frames.of(batch, self.axes, self.origins) if self.body_frame else None
        if frames is not None:
            levels = tuple(replace(level, rest=frames.into(i, level.rest)) for i, level in enumerate(levels))
            roots = frames.into(0, roots)
        template, grad = self.template.prepare(batch, levels[-1]), torch.is_grad_enabled()
        prepared = Prepared(batch, mass, share, levels, Solved.roots(roots), template, frames, rest, None, grad)
        return replace(prepared, still=self._outputs_at_rest(prepared)) if self.anchor else prepared

    def _outputs_at_rest(self, prepared: Prepared) -> tuple[Tensor, ...]:
        """The network's output for every unit of every predicted level where nothing moves."""
        units = [level.rest for level in prepared.levels]
        outputs: list[Tensor] = []
        with gathering_nothing([self.node_normaliser, self.edge_normaliser]):
            self._descend(prepared, units, units, 0.0, outputs)
        return tuple(outputs)

    def step(
        self,
        batch: SceneBatch,
        state: SimState,
        force: Float[Tensor, "K 3"] | None = None,
        prepared: Prepared | None = None,
        share: float = 1.0,
    ) -> Step:
        """Predicts the next frame.

        Args:
            batch: from :meth:`batch`.
            state: positions and previous positions of all kernels of the batch [scene units].
            force: force per kernel [mass scene units / s^2]; it displaces free kernels by f dt^2 / (2 m) before the
                step (METHOD section 6).
            prepared: from :meth:`prepare`, shared by steps between which no parameter changes; made here when None.
            share: factor on the network's output; 0 leaves the template alone.

        Raises:
            ValueError: ``prepared`` is of another batch, or carries no gradients while they are enabled.
        """
        prepared = self.prepare(batch) if prepared is None else prepared
        if prepared.batch is not batch or (torch.is_grad_enabled() and not prepared.with_gradients):
            raise ValueError(
                "step: `prepared` was made for another batch, or without gradients while they are enabled now. "
                "Call prepare(batch) where step is called."
            )
        if force is not None:
            state = self.pushed(prepared, state, force)
        with announced("the simulator's step"):
            return self._solve(prepared, state, share)

    def pushed(self, prepared: Prepared, state: SimState, force: Float[Tensor, "K 3"]) -> SimState:
        """The state that a force makes of a state: f dt^2 / (2 m) further, pinned kernels where they are."""
        batch = prepared.batch
        shift = force.index_select(0, batch.simulated) * batch.dt**2 / (2 * prepared.mass[:, None])
        shift = torch.where(batch.pinned[:, None], torch.zeros_like(shift), shift)
        return SimState(state.positions.index_add(0, batch.simulated, shift), state.previous)

    def _solve(self, prepared: Prepared, state: SimState, share: float) -> Step:
        """All predicted levels, coarse to fine, then the kernels."""
        now, before = prepared.units(state.positions), prepared.units(state.previous)
        finest, gradients, momentum, predicted = self._descend(prepared, now, before, share, [])
        frames, last = prepared.frames, len(prepared.levels) - 1
        if frames is not None:
            finest = frames.back(finest, prepared.rest)
            gradients = None if gradients is None else frames.turned_back(last, gradients)
            predicted = [frames.turned_back(i, f) for i, f in enumerate(predicted)]
        return Step(*inherit(finest, gradients, prepared.batch.kernels), momentum, tuple(predicted))

    def _descend(
        self, prepared: Prepared, now: list[Tensor], before: list[Tensor], share: float, outputs: list[Tensor]
    ) -> tuple[Solved, Tensor | None, Tensor, list[Tensor]]:
        """The predicted levels, coarse to fine: the finest one solved, the template's gradients, momentum and all F.

        The network's outputs, before anything is taken off, are appended to ``outputs``.
        """
        batch = prepared.batch
        if isinstance(prepared.template, PreparedScenes):
            seen = prepared.template.carried(Motion(prepared.levels[-1].rest, now[-1], before[-1]))
            now, before = prepared.per_level(seen.now), prepared.per_level(seen.before)
        units = [
            Units(fixed.rest, x, y, fixed.mass, fixed.log_density, fixed.attributes)
            for fixed, x, y in zip(prepared.levels, now, before, strict=True)
        ]
        template = prepared.template(Motion(units[-1].rest, units[-1].now, units[-1].before))
        targets = prepared.per_level(template.positions)
        above, momentum, predicted = prepared.roots, batch.rest.new_zeros(()), []
        for position, (level, unit, target) in enumerate(zip(batch.levels, units, targets, strict=True)):
            if position:
                above = replace(above, index=level.parent)
            still = None if prepared.still is None else prepared.still[position]
            output, gradient, rotation = self._predict(
                level, unit, above, target, position=position, share=share, still=still
            )
            outputs.append(output)
            predicted.append(gradient)
            accumulated, turned, after = advance(gradient, rotation, target, above)
            if position and self.conserve_momentum:
                momentum = momentum + _momentum(level, unit, after, above.after, prepared.levels[position - 1])
            above = Solved(unit.rest, unit.now, unit.before, after, target, accumulated, turned, above.index)
        return above, template.gradients, momentum, predicted

    def _fixes_shapes(self, positions: Tensor) -> bool:
        """Whether the number of edges must not depend on the state: where steps may be captured in a CUDA graph."""
        return self.edges.rule != "rest" and positions.device.type == "cuda" and not self.training

    def _predict(
        self,
        level: LevelBatch,
        unit: Units,
        above: Solved,
        target: Tensor,
        *,
        position: int,
        share: float,
        still: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The network's output, gradient and rotation of each unit of a level; identities for pinned units."""
        output = self._output(level, unit, above, target, position)
        moved = output if still is None else output - still
        return output, *self._head(moved * (share * level.free), level, above, target)

    def _output(self, level: LevelBatch, unit: Units, above: Solved, target: Tensor, position: int) -> Tensor:
        """The network's raw output for each unit of a level."""
        network = self.network[position] if isinstance(self.network, nn.ModuleList) else self.network
        coarse = self.options.coarse_inputs and position > 0
        fixed = self._fixes_shapes(unit.now)
        edge_index = (self.edges.fixed if fixed else self.edges.of)(level, unit.now)
        # Edges of the dummy node stand behind all others; their features are never seen, those of any node will do.
        present = edge_index.clamp_max(level.count - 1) if fixed else edge_index
        nodes, edges = network_inputs(
            unit, target, above, present, level.length, level.dt, self.gravity, self.options, coarse=coarse
        )
        nodes, edges = self.node_normaliser(nodes), self.edge_normaliser(edges)
        extra = self.edges.missing(edge_index.shape[1])
        if fixed or self.edges.bucket:
            nodes, edges = fill(nodes, 1), fill(edges, extra)
            edge_index = fill_edges(edge_index, level.count, extra)
        output: Tensor = network(nodes, edges, edge_index)[: level.count]
        return output

    def _head(self, output: Tensor, level: LevelBatch, above: Solved, target: Tensor) -> tuple[Tensor, Tensor]:
        """F and its rotation of each unit; the identity where the output is zero."""
        numbers = output[:, :11] * self.output_scale
        gradient, rotation = gradient_from_output(numbers, conserve_mass=self.conserve_mass)
        if not self.lever_head:
            return gradient, rotation
        lever = above.carry(target) - above.after.index_select(0, above.index)
        shift = output[:, 11:] * (self.lever_head * level.length)
        return lever_gradient(shift, lever, level.length, conserve_mass=self.conserve_mass) @ gradient, rotation


def _momentum(level: LevelBatch, unit: Units, after: Tensor, parents: Tensor, above: FixedUnits) -> Tensor:
    """sum_c ||m_c x_c - sum_{i in c} m_i x_i||^2 over the parents c; masses over the scene's, lengths over its size."""
    weighted = weighted_sum(after, unit.mass, level.parent, len(parents))
    return ((above.mass[:, None] * parents - weighted) / above.scale).square().sum()


def _check(
    predicted: Sequence[int],
    radii: Sequence[float],
    graph_radii: Sequence[float],
    angle: str,
    scenes: Sequence[GaussianScene],
    fps: Sequence[float],
) -> None:
    if not predicted or min(predicted) < 0 or list(predicted) != sorted(set(predicted), reverse=True):
        raise ConfigError(
            f"model.predicted_levels is {list(predicted)}; expected levels from coarse to fine, as [2, 1]."
        )
    if max(predicted) > len(radii):
        raise ConfigError(
            f"model.predicted_levels names level {max(predicted)}, but model.radii has {len(radii)} levels."
        )
    if len(graph_radii) != len(predicted):
        raise ConfigError(
            f"model.graph_radii has {len(graph_radii)} values for {len(predicted)} predicted levels; give one each."
        )
    if angle not in ANGLES:
        raise ConfigError(f"model.angle is '{angle}'; expected one of {', '.join(ANGLES)}.")
    if not scenes or len(scenes) != len(fps):
        raise ConfigError(
            f"{len(scenes)} scenes and {len(fps)} frame rates given; expected one rate per scene, at least one."
        )
