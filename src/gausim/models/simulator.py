"""GausSim: one step from x_{t-1}, x_t to x_{t+1}, coarse to fine (METHOD section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, DivergenceError, Forces, GaussianScene, SimState, Trajectory
from gausim.models.batch import BatchBuilder, GraphOptions, LevelBatch, SceneBatch
from gausim.models.features import FeatureOptions, UnitState, edge_features, node_features
from gausim.models.hierarchy import build_hierarchy
from gausim.models.template import Motion, RestTemplate, Template
from gausim.nn.meshgraphnet import MeshGraphNet
from gausim.nn.mlp import zero_output as initialise_zero
from gausim.nn.normaliser import RunningNormaliser
from gausim.ops.deformation import gradient_from_output, polar_rotation
from gausim.ops.neighbours import combine_edges

EDGE_RULES = ("rest", "union", "intersection")
ANGLES = ("cos_sin", "inner")


@dataclass(frozen=True, eq=False)
class Step:
    """What a step gives.

    Attributes:
        positions: x_{t+1} of all kernels of the batch [scene units].
        gradients: accumulated deformation gradients of the finest predicted units, per member plus its identity unit.
        rotations: their accumulated rotations.
        momentum: sum over levels and parents of ||m_c x_c - sum m_i x_i||^2; zero where it is switched off.
        predicted: the network's own gradients F, per predicted level, coarse to fine.
    """

    positions: Float[Tensor, "K 3"]
    gradients: Float[Tensor, "N 3 3"]
    rotations: Float[Tensor, "N 3 3"]
    momentum: Float[Tensor, ""]
    predicted: tuple[Float[Tensor, "_ 3 3"], ...]


@dataclass(frozen=True, eq=False)
class _Parents:
    """Solved state of the level above: per unit of the level below it, gathered by its parent index."""

    rest: Tensor
    now: Tensor
    before: Tensor
    after: Tensor
    template: Tensor
    gradient: Tensor
    rotation: Tensor

    def at(self, index: Tensor) -> _Parents:
        values = (self.rest, self.now, self.before, self.after, self.template, self.gradient, self.rotation)
        return _Parents(*(v.index_select(0, index) for v in values))


class GausSim(nn.Module):
    """The simulator of one or several scenes that share one network."""

    gravity: Tensor

    def __init__(
        self,
        scenes: Sequence[GaussianScene],
        fps: Sequence[float],
        *,
        radii: Sequence[float] = (0.1, 0.35),
        predicted_levels: Sequence[int] = (2, 1),
        clustering: str = "ball",
        graph_radii: Sequence[float] = (2.0, 0.4),
        max_neighbours: int = 16,
        edges: str = "union",
        angle: str = "cos_sin",
        rest_inputs: bool = False,
        coarse_inputs: bool = False,
        attributes: int = 4,
        hidden: int = 128,
        layers: int = 16,
        output_scale: float = 1.0,
        zero_output: bool = False,
        conserve_mass: bool = True,
        conserve_momentum: bool = True,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        normaliser_floor: float = 1e-2,
        template: Callable[..., Template] = RestTemplate,
    ) -> None:
        """Builds hierarchies, graph and network.

        Args:
            scenes: rest scenes, each with at least one pinned kernel.
            fps: frames per second of each scene's videos.
            radii: cluster diameters of levels 1..L [fractions of the diagonal].
            predicted_levels: levels whose gradients the network predicts, coarse to fine; [0] is "without hierarchy".
            clustering: ``ball`` or ``complete_linkage``.
            graph_radii: edge lengths per predicted level, same order [fractions of the diagonal].
            max_neighbours: edges per unit.
            edges: ``rest`` space only, or its ``union`` / ``intersection`` with the current state's neighbours.
            angle: ``cos_sin`` or ``inner`` (relative angle of an edge).
            rest_inputs: also give displacements and rest-space edge vectors to the network.
            coarse_inputs: read positions below the top level from the coarse prediction.
            attributes: material attributes per kernel.
            hidden: width of the network.
            layers: message-passing layers.
            output_scale: factor on the network's raw output.
            zero_output: start with zero output (identity gradients).
            conserve_mass: det F = 1.
            conserve_momentum: compute the momentum loss.
            gravity: acceleration [scene units / s^2].
            normaliser_floor: smallest standard deviation of a normalised input.
            template: what the gradients deform; called with (hierarchies, finest level, conserve_volume=conserve_mass).
        """
        super().__init__()
        _check(predicted_levels, radii, graph_radii, edges, angle, scenes, fps)
        self.scenes, self.fps = tuple(scenes), tuple(fps)
        self.predicted_levels = tuple(predicted_levels)
        self.edges, self.output_scale = edges, output_scale
        self.conserve_mass, self.conserve_momentum = conserve_mass, conserve_momentum
        self.options = FeatureOptions(angle, rest_inputs, coarse_inputs)
        self.hierarchies = tuple(build_hierarchy(s, radii=radii, clustering=clustering) for s in scenes)
        graph = GraphOptions(tuple(graph_radii), max_neighbours)
        self._builder = BatchBuilder(self.scenes, self.hierarchies, self.fps, self.predicted_levels, graph)
        self._batches: dict[tuple[tuple[int, ...], torch.device], SceneBatch] = {}
        self.register_buffer("gravity", torch.tensor([float(g) for g in gravity]), persistent=False)
        self.template: Template = template(self.hierarchies, self.predicted_levels[-1], conserve_volume=conserve_mass)
        counts = [h.levels[0].count for h in self.hierarchies]
        self.log_density = nn.ParameterList(torch.zeros(n) for n in counts)
        self.attributes = nn.ParameterList(torch.zeros(n, attributes) for n in counts)
        self.node_normaliser = RunningNormaliser(self.options.node_normalised, floor=normaliser_floor)
        self.edge_normaliser = RunningNormaliser(self.options.edge_normalised, floor=normaliser_floor)
        self.network = MeshGraphNet(
            node_features=self.options.node_normalised + 1 + attributes,
            edge_features=self.options.edge_size,
            outputs=11,
            hidden=hidden,
            layers=layers,
        )
        if zero_output:
            initialise_zero(self.network.decoder)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by role: networks, per-scene densities and attributes, and the rest of the template."""
        networks = self.template.networks()
        known = {id(p) for p in networks}
        return {
            "network": [*self.network.parameters(), *networks],
            "scene": [*self.log_density, *self.attributes],
            "template": [p for p in self.template.parameters() if id(p) not in known],
        }

    def batch(self, scene_ids: Sequence[int]) -> SceneBatch:
        """The disjoint union for one sequence of each of these scenes (cached)."""
        device = self.log_density[0].device
        key = (tuple(scene_ids), device)
        if key not in self._batches:
            self._batches[key] = self._builder.build(key[0], device)
        return self._batches[key]

    def masses(self, batch: SceneBatch) -> tuple[Float[Tensor, " M"], Float[Tensor, " M"]]:
        """Masses m = exp(r) V of the simulated kernels, and r."""
        log_density = torch.cat([self.log_density[i] for i in batch.scene_ids])
        return log_density.exp() * batch.volume, log_density

    def step(self, batch: SceneBatch, state: SimState, force: Float[Tensor, "K 3"] | None = None) -> Step:
        """Predicts the next frame.

        Args:
            batch: from :meth:`batch`.
            state: positions and previous positions of all kernels of the batch [scene units].
            force: force per kernel [mass scene units / s^2]; it displaces free kernels by f dt^2 / (2 m) before the
                step (METHOD section 6).
        """
        index = batch.simulated
        rest, now = batch.rest.index_select(0, index), state.positions.index_select(0, index)
        before = state.previous.index_select(0, index)
        mass, log_density = self.masses(batch)
        if force is not None:
            push = force.index_select(0, index) * batch.dt**2 / (2 * mass[:, None])
            now = torch.where(batch.pinned[:, None], now, now + push)
        attributes = torch.cat([self.attributes[i] for i in batch.scene_ids])
        kernels = (rest, now, before, mass, log_density, attributes)
        units = [_aggregate(level, kernels) for level in batch.levels]
        template = self.template(batch, Motion(units[-1].rest, units[-1].now, units[-1].before))
        targets = _template_per_level(batch, units, template.positions)
        identity = torch.eye(3, device=rest.device, dtype=rest.dtype).expand(len(rest), 3, 3)
        parents = _Parents(rest, rest, rest, rest, rest, identity, identity)
        momentum = rest.new_zeros(())
        predicted = []
        for position, (level, unit) in enumerate(zip(batch.levels, units, strict=True)):
            above = parents.at(level.parent)
            gradient, rotation = self._predict(level, unit, above, targets[position], top=position == 0)
            predicted.append(gradient)
            accumulated = gradient @ above.gradient
            after = above.after + _apply(accumulated, targets[position] - above.template)
            if position and self.conserve_momentum:
                momentum = momentum + _momentum(level, unit, after, parents.after)
            rotation = rotation @ above.rotation
            parents = _Parents(unit.rest, unit.now, unit.before, after, targets[position], accumulated, rotation)
        return self._finish(batch, parents, template.gradients, rest, momentum, tuple(predicted))

    def _predict(
        self, level: LevelBatch, unit: _Units, above: _Parents, target: Tensor, *, top: bool
    ) -> tuple[Tensor, Tensor]:
        """The network's gradient and rotation of each unit of a level; the identity for pinned units."""
        size = level.length
        coarse = above.after + _apply(above.gradient, target - above.template)
        own = UnitState(unit.rest / size, unit.now / size, unit.before / size, coarse / size)
        parent = UnitState(above.rest / size, above.now / size, above.before / size, above.after / size)
        replace = self.options.coarse_inputs and not top
        edge_index = level.rest_edges
        if self.edges != "rest":
            edge_index = combine_edges(edge_index, level.current_edges(unit.now), level.count, rule=self.edges)
        nodes = node_features(
            own,
            parent,
            level.dt,
            self.gravity / size,
            unit.log_density,
            unit.attributes,
            self.options,
            coarse=replace,
        )
        edges = edge_features(own, parent, edge_index, level.dt, self.options, coarse=replace)
        output = self.network(self.node_normaliser(nodes), self.edge_normaliser(edges), edge_index)
        output = torch.where(level.pinned[:, None], torch.zeros_like(output), output * self.output_scale)
        return gradient_from_output(output, conserve_mass=self.conserve_mass)

    def _finish(
        self,
        batch: SceneBatch,
        finest: _Parents,
        template: Tensor | None,
        rest: Tensor,
        momentum: Tensor,
        predicted: tuple[Tensor, ...],
    ) -> Step:
        """Kernels inherit from the finest predicted units: x_k = x_c + G_c (X_k - X_c)."""
        gradient, rotation = finest.gradient, finest.rotation
        if template is not None:
            gradient = gradient @ template
            rotation = rotation @ polar_rotation(template.detach())
        unit = batch.levels[-1].unit_of_kernel
        offset = rest - finest.rest.index_select(0, unit)
        moved = finest.after.index_select(0, unit) + _apply(gradient.index_select(0, unit), offset)
        moved = torch.where(batch.pinned[:, None], rest, moved)
        positions = batch.rest.index_copy(0, batch.simulated, moved)
        identity = torch.eye(3, device=rest.device, dtype=rest.dtype)[None]
        spans = batch.levels[-1].spans

        def with_identity(value: Tensor) -> Tensor:
            return torch.cat([part for span in spans for part in (value[span], identity)])

        return Step(positions, with_identity(gradient), with_identity(rotation), momentum, predicted)

    def dynamics(self, scene_id: int = 0) -> SceneDynamics:
        """The simulator bound to one scene, as the protocol :class:`gausim.core.Dynamics`."""
        return SceneDynamics(self, scene_id)


@dataclass(frozen=True, eq=False)
class _Units:
    """Mass-weighted aggregates of one level."""

    rest: Tensor
    now: Tensor
    before: Tensor
    mass: Tensor
    log_density: Tensor
    attributes: Tensor


def _aggregate(level: LevelBatch, kernels: tuple[Tensor, ...]) -> _Units:
    """y_c = sum m_i y_i / m_c, rho_c = m_c / V_c, a_c = mean of a_i (METHOD section 1)."""
    rest, now, before, mass, log_density, attributes = kernels
    index, count = level.unit_of_kernel, level.count
    total = mass.new_zeros(count).index_add(0, index, mass)
    weighted = torch.cat((rest, now, before), 1) * mass[:, None]
    positions = mass.new_zeros(count, 9).index_add(0, index, weighted) / total[:, None]
    members = mass.new_zeros(count).index_add(0, index, torch.ones_like(mass))
    mean = attributes.new_zeros(count, attributes.shape[1]).index_add(0, index, attributes) / members[:, None]
    log_unit = torch.log(total / level.volume)
    return _Units(positions[:, 0:3], positions[:, 3:6], positions[:, 6:9], total, log_unit, mean)


def _template_per_level(batch: SceneBatch, units: list[_Units], finest: Tensor) -> list[Tensor]:
    """Template positions of every predicted level: coarse units at the centre of mass of their children."""
    targets = [finest]
    for position in range(len(batch.levels) - 1, 0, -1):
        level, mass, count = batch.levels[position], units[position].mass, batch.levels[position - 1].count
        summed = finest.new_zeros(count, 3).index_add(0, level.parent, targets[0] * mass[:, None])
        targets.insert(0, summed / units[position - 1].mass[:, None])
    return targets


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _momentum(level: LevelBatch, unit: _Units, after: Tensor, parents: Tensor) -> Tensor:
    """sum_c ||m_c x_c - sum_{i in c} m_i x_i||^2 over the parents c of a level."""
    weighted = torch.zeros_like(parents).index_add(0, level.parent, after * unit.mass[:, None])
    total = parents.new_zeros(len(parents)).index_add(0, level.parent, unit.mass)
    return (total[:, None] * parents - weighted).square().sum()


class SceneDynamics:
    """Rolls one scene of a :class:`GausSim` out, without gradients and in evaluation mode."""

    def __init__(self, model: GausSim, scene_id: int) -> None:
        """Binds ``model`` to its scene number ``scene_id``."""
        self.model, self.scene_id = model, scene_id

    @torch.no_grad()
    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; frame 0 is the initial state with identity gradients (METHOD: the rest state).

        Raises:
            DivergenceError: a position or force is not finite; the message names the frame.
        """
        was_training = self.model.training
        self.model.eval()
        try:
            return self._rollout(initial, steps, forces)
        finally:
            self.model.train(was_training)

    def _rollout(self, initial: SimState, steps: int, forces: Forces | None) -> Trajectory:
        batch = self.model.batch((self.scene_id,))
        member = batch.members[0]
        units = member.units.stop - member.units.start
        identity = torch.eye(3).to(initial.positions).expand(units, 3, 3)
        positions, gradients, rotations = [initial.positions], [identity], [identity]
        state = initial
        self._require_finite("positions", torch.stack((initial.positions, initial.previous)), 0)
        for number in range(steps):
            force = forces(number) if forces is not None else None
            if force is not None:
                self._require_finite("forces", force, number)
            result = self.model.step(batch, state, force)
            self._require_finite("positions", result.positions, number + 1)
            state = SimState(result.positions, state.positions)
            positions.append(result.positions)
            gradients.append(result.gradients)
            rotations.append(result.rotations)
        return Trajectory(
            torch.stack(positions),
            torch.stack(gradients),
            torch.stack(rotations),
            member.unit_of_kernel,
            self.model.fps[self.scene_id],
        )

    def _require_finite(self, name: str, value: Tensor, frame: int) -> None:
        if not bool(torch.isfinite(value).all()):
            raise DivergenceError(
                f"{self.model.scenes[self.scene_id].name}: {name} are not finite at frame {frame}. "
                "Reset the state, or use a smaller force or a model trained longer."
            )


def _check(
    predicted: Sequence[int],
    radii: Sequence[float],
    graph_radii: Sequence[float],
    edges: str,
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
    if edges not in EDGE_RULES:
        raise ConfigError(f"model.edges is '{edges}'; expected one of {', '.join(EDGE_RULES)}.")
    if angle not in ANGLES:
        raise ConfigError(f"model.angle is '{angle}'; expected one of {', '.join(ANGLES)}.")
    if not scenes or len(scenes) != len(fps):
        raise ConfigError(
            f"{len(scenes)} scenes and {len(fps)} frame rates given; expected one rate per scene, at least one."
        )
