"""Input features of the network (METHOD section 3)."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import ConfigError, GaussianScene
from gausim.models.step.recursion import Solved, Units

# Floor of lengths, which are in diagonals of the scene.
TINY = 1e-6
# Nearness to the floor, and the floor's normal times the nearness; the last node features.
FLOOR_FEATURES = 4


@dataclass(frozen=True)
class FeatureOptions:
    """Choice of the network's input features.

    Attributes:
        rest_inputs: add displacements, rest-space edge vectors and the template's prediction.
        coarse_inputs: below the top level use positions of the coarse prediction instead of the current state.
        velocities: use velocities and accelerations; without them, levers X_i - X_p, displacements and the parent's
            displacement of the template position.
        centred: positions in the middle of the step, where the template takes its forces: with its prediction they are
            (x_{t+1} + 2 x_t + x_{t-1}) / 4. What turns round in every frame is not seen there, and not driven on.
        history: frames before the last two of which the velocities are inputs, too; for bodies in fixed pins.
        attributes: material attributes per unit.
        floor: nearness of the units to the floor, in models of which a scene has one.

    Raises:
        ConfigError: neither velocities nor rest_inputs, or a negative history.
    """

    rest_inputs: bool = True
    coarse_inputs: bool = False
    velocities: bool = False
    centred: bool = True
    history: int = 0
    attributes: int = 8
    floor: bool = True

    def __post_init__(self) -> None:
        if self.history < 0:
            raise ConfigError(f"model.simulator.features.history: expected at least 0, got {self.history}.")
        if not (self.velocities or self.rest_inputs):
            raise ConfigError(
                "model.simulator.features.velocities=false needs rest_inputs=true, else no input depends on the motion."
            )

    def of(self, scenes: Sequence[GaussianScene]) -> "FeatureOptions":
        """The features of a model of these scenes: without the floor where none of them has one."""
        return replace(self, floor=self.floor and any(scene.surroundings.floor for scene in scenes))

    def positions(
        self, before: Float[Tensor, "N 3"], now: Float[Tensor, "N 3"], after: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Positions among the inputs, from those at t - 1, t and t + 1 (the template's prediction)."""
        return now + (after - 2 * now + before) / 4 if self.centred else now

    @property
    def node_normalised(self) -> int:
        """Number of leading node features that are normalised."""
        own = (12 if self.rest_inputs else 6) if self.velocities else 9
        return own + 3 * self.history

    @property
    def node_size(self) -> int:
        """Number of node features."""
        return self.node_normalised + 1 + self.attributes + (FLOOR_FEATURES if self.floor else 0)

    @property
    def edge_normalised(self) -> int:
        """Number of leading edge features that are normalised."""
        return (13 if self.rest_inputs else 7) - (0 if self.velocities else 3)

    @property
    def edge_size(self) -> int:
        """Number of edge features."""
        return self.edge_normalised + 2


def safe_norm(x: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 1"]:
    """Length, with a finite derivative at zero."""
    return (x * x).sum(-1, keepdim=True).add(TINY**2).sqrt()


def network_inputs(
    unit: Units,
    target: Float[Tensor, "N 3"],
    above: Solved,
    edge_index: Int[Tensor, "2 E"],
    size: Float[Tensor, "N 1"],
    dt: Float[Tensor, "N 1"],
    options: FeatureOptions,
    *,
    coarse: bool = False,
) -> tuple[Float[Tensor, "N Cn"], Float[Tensor, "E Ce"]]:
    """Node and edge features of the units of one level, from their graph and their solved parents.

    Nodes have the inertial acceleration of the parent's frame and the local velocity, and with
    ``rest_inputs`` the displacement and the velocity to the coarse prediction; or what ``velocities=False`` stands for.
    ``target`` are the units' template positions, ``size`` the diagonals of their scenes [scene units]; ``coarse``
    selects positions of the coarse prediction instead of the current ones. Velocities of earlier frames follow.
    """
    coarsely = above.carry(target)
    # Positions at rest, at t, t - 1 and t + 1 of units and parents in diagonals, stacked and gathered together: on a
    # CPU the number of operations dominates the cost.
    own = torch.stack((unit.rest, unit.now, unit.before, coarsely)) / size
    parents = torch.stack((above.rest, above.now, above.before, above.after)).index_select(1, above.index) / size
    edges = edge_features(own, parents, edge_index, dt, options, coarse=coarse)
    rest, now, before, after = own.unbind()
    if options.velocities:
        _, parent, parent_before, parent_after = parents.unbind()
        inertial = -(parent_after - 2 * parent + parent_before) / dt**2
        local = after - parent_after if coarse else now - parent
        columns = [inertial, (local - (before - parent_before)) / dt]
        if options.rest_inputs:
            columns += [now - rest, (after - now) / dt]
    else:
        lever = (unit.rest - above.rest.index_select(0, above.index)) / size
        columns = [lever, now - rest, (coarsely - target) / size]
    past = (unit.before, *unit.older)
    columns += [(late - early) / (size * dt) for late, early in itertools.pairwise(past)]
    columns += [unit.log_density[:, None], unit.attributes]
    if options.floor:
        near = unit.floor
        columns.append(unit.rest.new_zeros(len(unit.rest), FLOOR_FEATURES) if near is None else near)
    return torch.cat(columns, -1), edges


def edge_features(
    units: Float[Tensor, "4 N 3"],
    parents: Float[Tensor, "4 N 3"],
    edge_index: Int[Tensor, "2 E"],
    dt: Float[Tensor, "N 1"],
    options: FeatureOptions,
    *,
    coarse: bool = False,
) -> Float[Tensor, "E C"]:
    """Stretch ratio, direction, relative velocity and relative angle about the destination's barycentre.

    ``units`` and their ``parents`` are positions at rest, at t, t - 1 and t + 1 [diagonals]; t + 1 is the coarse
    prediction of units. With ``coarse`` the features are computed from t + 1 instead of t.
    """
    s, d = edge_index
    current = 3 if coarse else 1
    places = torch.stack((units[0], units[current], units[2]), 1)
    source, destination = places.index_select(0, s), places.index_select(0, d)
    offset = destination - source
    rest, now, before = offset.unbind(1)
    rest_length, length = safe_norm(offset[:, :2]).unbind(1)
    columns = [length / rest_length, now / length]
    if options.velocities:
        columns.append((now - before) / dt.index_select(0, d))
    if options.rest_inputs:
        columns += [rest, now - rest]
    about = torch.stack((parents[0], parents[current]), 1).index_select(0, d)
    columns.append(_angle_change(destination[:, :2] - about, source[:, :2] - about))
    return torch.cat(columns, -1)


def _angle_change(a: Float[Tensor, "E 2 3"], b: Float[Tensor, "E 2 3"]) -> Float[Tensor, "E 2"]:
    """Cosine and sine of the change of the angle between two vectors from rest to now, which are on axis 1."""
    dot = (a * b).sum(-1, keepdim=True)
    scale = safe_norm(a) * safe_norm(b)
    # The floor is the square of that of lengths: a unit on its barycentre gives 0, not 1 / length.
    across = torch.linalg.cross(a, b).square().sum(-1, keepdim=True).add(TINY**4).sqrt()
    (c0, c1), (s0, s1) = (dot / scale).unbind(1), (across / scale).unbind(1)
    return torch.cat((c1 * c0 + s1 * s0, s1 * c0 - c1 * s0), -1)
