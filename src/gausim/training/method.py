"""The trained method: one simulator of all scenes with an initial state of every sequence."""

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import nn
from torch.optim import Optimizer

from gausim.core import ConfigError, HandPath, Hands, SimState, Trajectory
from gausim.data.dataset import SequenceSample
from gausim.models.hierarchy.units import UnitMotion
from gausim.models.reference.reference import Carried, hand_motion
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.training.contracts import Simulator
from gausim.training.optimizers import OptimizerSettings


class SharedSimulator:
    """A simulator of all scenes and a trainable initial state of every sequence: the paper's method.

    ``initial_states`` (:mod:`gausim.models.initial_state`) have one parameter per training sequence, in their order.
    """

    name = "gausim"  # in tables: that of the model's file
    initial_states: nn.Module

    def __init__(
        self,
        model: nn.Module,
        initial_states: nn.Module,
        scene_of_sequence: Sequence[int],
        hands: Sequence[HandPath | None] = (),
    ) -> None:
        """Stores the parts; ``hands`` are the paths of the hands of each sequence, empty where there are none."""
        self.model, self.initial_states = model, initial_states
        self.scene_of_sequence = tuple(scene_of_sequence)
        count = len(self.scene_of_sequence)
        if (own := len(list(initial_states.parameters()))) != count:
            raise ConfigError(f"initial states: {own} parameters for {count} sequences; expected one each.")
        self._simulator, self.states = cast(Simulator, model), cast(Any, initial_states)
        self._hands = dict(enumerate(hands))
        for sequence_id, path in self._hands.items():
            if path is not None:
                self.states.hold(sequence_id, path)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """The model's parameter groups, and the initial states."""
        return {**self._simulator.parameter_groups(), "initial": list(self.initial_states.parameters())}

    def build(self, settings: OptimizerSettings) -> Optimizer:
        """One optimiser over the groups of the model and the initial states."""
        return settings.build({name: [p for p in own if p.requires_grad] for name, own in self.groups().items()})

    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """x_0 and x_{-1} of the sequences of a batch."""
        states = [self.state(s.sequence_id) for s in samples]
        now, before = torch.cat([s.positions for s in states]), torch.cat([s.previous for s in states])
        return SimState(now.to(batch.rest), before.to(batch.rest))

    def state(self, sequence_id: int) -> SimState:
        """The state at which rollouts of a sequence begin."""
        state: SimState = self.states.state(sequence_id)
        return state

    def hands(self, sequence_id: int) -> Hands | None:
        """Poses of the hands of a sequence; None where it has none."""
        path = self._hands.get(sequence_id)
        return None if path is None else path.pose

    @torch.no_grad()
    def references(self, sequence_id: int, steps: int) -> list[tuple[Carried, UnitMotion]] | None:
        """References of a body in hands in the steps to frames 1..T, and their loads."""
        hands = self.hands(sequence_id)
        if hands is None:
            return None
        batch = self._simulator.batch([self.scene_of_sequence[sequence_id]])
        prepared, rest = self._simulator.prepare(batch), SimState(batch.rest, batch.rest)
        return [prepared.aggregate(rest, [hand_motion(hands, frame)]) for frame in range(steps)]

    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a training sequence from its initial state, for all kernels of its scene."""
        dynamics = SceneDynamics(cast(Any, self.model), self.scene_of_sequence[sequence_id])
        return dynamics.rollout(self.state(sequence_id), steps, hands=self.hands(sequence_id))
