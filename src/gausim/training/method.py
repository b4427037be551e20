"""Trainable methods: one simulator of all sequences, or a method that is fitted to every sequence separately."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import nn
from torch.optim import Optimizer

from gausim.core import ConfigError, HandPath, Hands, SimState, Trajectory
from gausim.data.dataset import SequenceSample
from gausim.losses.objective import Objective
from gausim.models.hierarchy.units import UnitMotion
from gausim.models.reference.reference import Carried, hand_motion
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.training.contracts import Simulator
from gausim.training.optimizers import OptimizerSettings, set_rates
from gausim.training.plan import TrainingPlan
from gausim.training.terms.mixing import mixing_term
from gausim.training.terms.rest import rest_term
from gausim.training.terms.term import Term


@dataclass(frozen=True)
class Moment:
    """Position of an optimiser step: ``batch`` of ``batches`` in its epoch, and the part of the run that is done."""

    batch: int
    batches: float
    progress: float


@dataclass(frozen=True)
class Task:
    """Settings of the next optimiser step: the logged learning rate, and a new objective and settings, if any.

    ``is_new`` requires the losses of the rest state to be computed again.
    """

    rate: float
    objective: Objective | None = None
    settings: OptimizerSettings | None = None
    is_new: bool = False


class Method(ABC):
    """Interface of a trainable method: its parameters, initial states and learning rates.

    Attributes:
        name: its row in tables.
        extrapolates: whether it predicts frames beyond the training frames.
        model: the simulator of a batch (:class:`gausim.training.contracts.Simulator`).
        initial_states: initial-state parameters of the sequences; None where they belong to the model.
        scene_of_sequence: the scene of each training sequence.
        learns: whether it has trainable parameters.
        defers: whether reads that block the host may be deferred to the end of a step.
        warns: whether a static prediction is reported as a collapse.
    """

    name: str
    extrapolates: bool
    model: nn.Module
    initial_states: nn.Module | None
    scene_of_sequence: Sequence[int]
    learns, defers, warns = True, True, True

    @abstractmethod
    def groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by group; each group has a learning rate."""

    @abstractmethod
    def build(self, settings: OptimizerSettings) -> Optimizer | None:
        """The optimiser over all groups; None without trainable parameters."""

    @abstractmethod
    def begin_step(self, optimizer: Optimizer, settings: OptimizerSettings, plan: TrainingPlan, now: Moment) -> Task:
        """Sets the learning rates, and returns the settings of the step."""

    @abstractmethod
    def terms(self) -> Sequence[Term]:
        """Loss terms in addition to the rollout's, in the order of their backward passes."""

    @abstractmethod
    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """Initial state of the rollouts of a batch; loss gradients flow into it."""

    @abstractmethod
    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a training sequence.

        Raises:
            DivergenceError: a position is not finite; names the frame.
        """

    def hands(self, sequence_id: int) -> Hands | None:
        """Poses of the hands of a sequence; None where it has none."""
        return None

    def references(self, sequence_id: int, steps: int) -> list[tuple[Carried, UnitMotion]] | None:
        """References of a body in hands in the steps to frames 1..T, and their loads; they do not depend on its motion.

        None without hands: the reference is the rest state.
        """
        return None

    def end_epoch(self, least: float) -> bool:
        """Prepares the next epoch; returns whether training is over. ``least`` is the used part of the time."""
        return False

    def notes(self) -> list[str]:
        """Notes on its figures, in sentences."""
        return []

    def state_dict(self) -> dict[str, Any]:
        """State of a resumed run in addition to the parameters, as plain containers."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores the state."""
        self.take_notes(state)

    def take_notes(self, state: Mapping[str, Any]) -> None:  # noqa: B027
        """Restores the part of the state that :meth:`notes` needs."""


class SharedSimulator(Method):
    """A simulator of all scenes and a trainable initial state of every sequence: the paper's method.

    ``initial_states`` (:mod:`gausim.models.initial_state`) have one parameter per training sequence, in their order.
    """

    name, extrapolates = "gausim", True
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
        self._simulator, self._states = cast(Simulator, model), cast(Any, initial_states)
        self._hands = dict(enumerate(hands))
        for sequence_id, path in self._hands.items():
            if path is not None:
                self._states.hold(sequence_id, path)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """The model's parameter groups, and the initial states."""
        return {**self._simulator.parameter_groups(), "initial": list(self.initial_states.parameters())}

    def build(self, settings: OptimizerSettings) -> Optimizer:
        """One optimiser over the groups of the model and the initial states."""
        return settings.build({name: [p for p in own if p.requires_grad] for name, own in self.groups().items()})

    def begin_step(self, optimizer: Optimizer, settings: OptimizerSettings, plan: TrainingPlan, now: Moment) -> Task:
        """Sets the learning rates by the plan."""
        shared = getattr(self.model, "shared_groups", ("network",))
        set_rates(optimizer, lambda name: plan.rate_factor(name, now.progress, shared=name in shared))
        return Task(settings.network_lr * plan.rate_factor("network", now.progress))

    def terms(self) -> Sequence[Term]:
        """The static loss and the penalty on mode mixing."""
        return rest_term, mixing_term

    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """x_0 and x_{-1} of the sequences of a batch."""
        states = [self.state(s.sequence_id, s.start) for s in samples]
        return SimState(
            *(torch.cat(x).to(batch.rest) for x in zip(*((s.positions, s.previous) for s in states), strict=True))
        )

    def state(self, sequence_id: int, start: int = 0) -> SimState:
        """The state at which rollouts of a sequence begin; ``start`` is 0 where states of later frames are unknown."""
        state: SimState = self._states.state(sequence_id)
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
