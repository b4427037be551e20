"""Fit of a method to its sequences in stages, with the optimiser step of a simulator.

A fitted method differs from a simulator in three points: its state is more than two positions, its parameters belong to
sequences, and the objective changes from stage to stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from gausim.core import FittedDynamics, FittedMethod, FittedState, Frame, GaussianScene, SimState, Trajectory
from gausim.data.dataset import SequenceSample
from gausim.losses.objective import Objective
from gausim.models.hierarchy.batch import Member
from gausim.training.fitted.stages import FitPlan, StagedCurriculum
from gausim.training.method import Method, Moment, Task
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import TrainingPlan
from gausim.training.terms.term import StepInputs, Term


@dataclass(frozen=True, eq=False)
class Carried(SimState):
    """Positions of all members of a batch, and the members' complete states."""

    parts: tuple[FittedState, ...]

    @staticmethod
    def of(parts: Sequence[FittedState]) -> Carried:
        """Concatenates the members' states."""
        positions = torch.cat([part.positions for part in parts])
        return Carried(positions, positions, tuple(parts))

    def detach(self) -> Carried:
        """The same values without a graph."""
        return Carried.of([part.detach() for part in self.parts])


@dataclass(frozen=True, eq=False)
class Batch:
    """Batch of independent sequences (see :class:`gausim.training.contracts.SceneBatch`)."""

    rest: Float[Tensor, "K 3"]
    members: tuple[Member, ...]


class Sequences(nn.Module):
    """Simulator interface of a fitted method: a batch of independent sequences."""

    def __init__(self, method: FittedMethod) -> None:
        super().__init__()
        self.method = cast(Any, method)
        self.scenes: Sequence[GaussianScene] = method.scenes

    def batch(self, scene_ids: Sequence[int]) -> Batch:
        """The batch of one sequence per entry."""
        device = next((p.device for p in self.parameters()), torch.device("cpu"))
        places, kernels, units = [], 0, 0
        for scene_id in scene_ids:
            unit = self.method.unit_of_kernel(scene_id).to(device)
            ends = kernels + len(unit), units + int(unit.max()) + 1
            places.append(Member(scene_id, slice(kernels, ends[0]), slice(units, ends[1]), unit))
            kernels, units = ends
        return Batch(torch.cat([self.scenes[i].means for i in scene_ids]).to(device), tuple(places))

    def prepare(self, batch: Batch) -> None:
        """Does nothing: steps have only the state in common."""

    def step(self, batch: Batch, state: Carried, force: None = None, prepared: None = None) -> Frame:
        """The next frame of every sequence."""
        parts = [self.method.advance(part) for part in state.parts]
        following = Carried.of(parts)
        deformation_gradients, rotations = (
            torch.cat([getattr(p, name) for p in parts]) for name in ("deformation_gradients", "rotations")
        )
        no_momentum = rotations.new_zeros(())
        return Frame(following.positions, deformation_gradients, rotations, following, no_momentum)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The method's parameter groups."""
        return {name: list(members) for name, members in self.method.parameter_groups().items()}


class StagedFit(Method):
    """A method with parameters for every sequence, fitted stage by stage.

    With ``plan.batch_size`` 1 the fits of the sequences are independent (loss gradients are clipped per sequence),
    except for parameters of the whole object. The stages of the ``plan`` set T of the ``curriculum``; a rollout ends
    where a kernel is further than ``explosion`` from rest [diagonals of the scene].
    """

    model: Sequences
    initial_states, defers, warns = None, False, False  # no rest state to continue from after an explosion

    def __init__(self, fitted: FittedMethod, plan: FitPlan, curriculum: StagedCurriculum, explosion: float) -> None:
        penalties = sorted(fitted.penalties(0)) if any(s.penalties for _, s in plan.order) else []
        plan.check(fitted.parameter_groups(), penalties)
        self.fitted, self.plan, self.curriculum = fitted, plan, curriculum
        self.model = Sequences(fitted)
        self.name, self.extrapolates, self.learns = fitted.name, fitted.extrapolates, bool(plan.order)
        self.scene_of_sequence = fitted.scene_of_sequence
        self.stage, self.made = "", dict.fromkeys((name for name, _ in plan.order), 0.0)
        self._explosion = explosion

    def notes(self) -> list[str]:
        """The fitted method's notes, and a note on shortened stages."""
        notes = list(self.fitted.notes())
        for name, stage in self.plan.order:
            if stage.iterations < stage.original:
                notes.append(
                    f"Stage {name} is of {stage.iterations} iterations per sequence; the original takes "
                    f"{stage.original} or more."
                )
            if round(self.made[name]) < stage.iterations:
                notes.append(
                    f"Stage {name} had {self.made[name]:.0f} of its {stage.iterations} iterations per sequence."
                )
        return notes

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """The fitted method's parameter groups."""
        return self.model.parameter_groups()

    def build(self, settings: OptimizerSettings) -> Optimizer | None:
        """One optimiser over the groups of the method; the stages set their learning rates. None without stages."""
        made = [{"params": own, "lr": 0.0, "name": name} for name, own in self.groups().items() if own]
        return (self.plan.optimizer or Adam)(made) if made and self.plan.order else None

    def begin_step(self, optimizer: Optimizer, settings: OptimizerSettings, plan: TrainingPlan, now: Moment) -> Task:
        """Enters the stage of the epoch and sets its learning rates; the largest is logged."""
        batches = max(1.0, now.batches)
        name, stage, begun = self.plan.place(self.curriculum.position)
        self.made[name] += self.plan.shows / batches
        iteration = begun + now.batch / batches * self.plan.shows
        for group in optimizer.param_groups:
            group["lr"] = stage.rate(group["name"], iteration)
            for parameter in group["params"]:
                parameter.requires_grad_(group["name"] in stage.rates)
        before, self.stage = self.stage, name
        objective = Objective(
            image=stage.loss, explosion=self._explosion, backprop_steps=stage.backprop_steps, static_weight=0.0
        )
        rate = max(stage.rate(group, iteration) for group in stage.rates)
        return Task(rate, objective, OptimizerSettings(clip_norm=stage.clip_norm), is_new=before not in ("", name))

    def end_epoch(self, least: float) -> bool:
        """Moves to the next epoch's position in the plan: one epoch on, or further if the time budget demands it."""
        self.curriculum.enter(max(self.curriculum.position + 1, least * self.plan.epochs))
        return self.curriculum.position >= self.plan.epochs

    def terms(self) -> Sequence[Term]:
        """The stage's penalties."""
        return (self._descend,)

    def _descend(self, step: StepInputs) -> None:
        """Backward pass of the penalties of this rank's sequences, for the mean over all sequences of the step."""
        weights = dict(self.plan.order)[self.stage].penalties
        if not weights:
            return
        for facts in step.whole[step.ranks.rank :: step.ranks.size]:
            found = self.fitted.penalties(facts.sequence_id)
            loss = torch.stack([weight * found[name] for name, weight in weights.items()]).sum()
            step.backward(loss / len(step.whole))

    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """The method's state at frame 0 of every sequence."""
        return Carried.of([self.fitted.begin(s.sequence_id) for s in samples])

    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a sequence."""
        rest = self.fitted.scenes[self.scene_of_sequence[sequence_id]].means
        return FittedDynamics(self.fitted, sequence_id).rollout(SimState(rest, rest), steps)

    def state_dict(self) -> dict[str, Any]:
        """The position of the fit in the plan."""
        place = self.curriculum.state_dict() if self.learns else {}
        return {"plan": {"place": place, "stage": self.stage, "made": dict(self.made)}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores the position in the plan."""
        self.take_notes(state)
        self.curriculum.load_state_dict(state["plan"]["place"])

    def take_notes(self, state: Mapping[str, Any]) -> None:
        """Restores the stage and the iterations done in each stage."""
        self.stage = state["plan"]["stage"]
        self.made.update(state["plan"]["made"])
