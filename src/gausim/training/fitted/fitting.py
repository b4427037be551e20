"""Fits a method to its sequences in stages: the training module with the method's own state, losses and rates.

A second loop would have to repeat what the first has: stretches through which gradients flow, drawing that keeps no
image, divergence checks, ranks, exact resume, budgets, loggers and pictures. A fitted method differs in three points,
and only these are here: its state is more than two positions, its parameters belong to sequences, and what is
minimised changes from stage to stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from gausim.core import (
    ConfigError,
    FittedDynamics,
    FittedMethod,
    FittedState,
    GaussianScene,
    Renderer,
    SimState,
    Trajectory,
)
from gausim.data.dataset import SequenceSample
from gausim.losses.objective import Objective
from gausim.training.baseline_metrics import Baselines
from gausim.training.fitted.stages import FitPlan, Stage, StagedCurriculum
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings
from gausim.training.supervision.images import Supervision
from gausim.training.terms.term import StepInputs, Term


@dataclass(frozen=True, eq=False)
class Carried(SimState):
    """Positions of all members of a batch, and the whole states that they are of."""

    parts: tuple[FittedState, ...]

    @staticmethod
    def of(parts: Sequence[FittedState]) -> Carried:
        """Joins the members."""
        positions = torch.cat([part.positions for part in parts])
        return Carried(positions, positions, tuple(parts))

    def detach(self) -> Carried:
        """The same numbers without history."""
        return Carried.of([part.detach() for part in self.parts])


@dataclass(frozen=True, eq=False)
class FittedStep:
    """One predicted frame of a batch (see :class:`gausim.training.contracts.Step`) and the state to go on from."""

    positions: Float[Tensor, "K 3"]
    deformation_gradients: Float[Tensor, "N 3 3"]
    rotations: Float[Tensor, "N 3 3"]
    momentum: Float[Tensor, ""]
    state: Carried


@dataclass(frozen=True, eq=False)
class Place:
    """Where one sequence stands in a batch (see :class:`gausim.training.contracts.Member`)."""

    scene_id: int
    kernels: slice
    units: slice
    unit_of_kernel: Int[Tensor, " K"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Several sequences side by side (see :class:`gausim.training.contracts.SceneBatch`)."""

    rest: Float[Tensor, "K 3"]
    members: tuple[Place, ...]


class Sequences(nn.Module):
    """A fitted method as the simulator of a batch: sequences side by side, each by itself."""

    def __init__(self, method: FittedMethod) -> None:
        """Keeps the method."""
        super().__init__()
        self.method = cast(nn.Module, method)
        self.scenes: Sequence[GaussianScene] = method.scenes

    @property
    def fitted(self) -> FittedMethod:
        """The method, as what it can do."""
        return cast(FittedMethod, self.method)

    def batch(self, scene_ids: Sequence[int]) -> Batch:
        """Rows of one sequence per entry."""
        device = next((p.device for p in self.parameters()), torch.device("cpu"))
        places, kernels, units = [], 0, 0
        for scene_id in scene_ids:
            unit = self.fitted.unit_of_kernel(scene_id).to(device)
            ends = kernels + len(unit), units + int(unit.max()) + 1
            places.append(Place(scene_id, slice(kernels, ends[0]), slice(units, ends[1]), unit))
            kernels, units = ends
        return Batch(torch.cat([self.scenes[i].means for i in scene_ids]).to(device), tuple(places))

    def prepare(self, batch: Batch) -> None:
        """Nothing is shared between steps but what a state carries."""

    def step(self, batch: Batch, state: Carried, force: None = None, prepared: None = None) -> FittedStep:
        """The next frame of every sequence."""
        parts = [self.fitted.advance(part) for part in state.parts]
        following = Carried.of(parts)
        deformation_gradients, rotations = (
            torch.cat([getattr(p, n) for p in parts]) for n in ("deformation_gradients", "rotations")
        )
        return FittedStep(
            following.positions, deformation_gradients, rotations, deformation_gradients.new_zeros(()), following
        )

    def shared(self) -> dict[str, nn.Module]:
        """Nothing that another run could take over."""
        return {}

    def own(self, scene_id: int) -> tuple[str, ...]:
        """Nothing, likewise."""
        return ()

    def freeze(self, *, scenes: bool = False) -> None:
        """Keeps everything as it is."""
        self.requires_grad_(False)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The method's."""
        return {name: list(members) for name, members in self.fitted.parameter_groups().items()}


class Penalties:
    """What a stage asks of a method beside the rollout's loss."""

    def __init__(self, method: FittedMethod, weights: Mapping[str, float]) -> None:
        """Keeps the method and the weights of its penalties by name."""
        self._method, self._weights = method, weights

    def descend(self, step: StepInputs) -> None:
        """Backward of the sequences that are this rank's; the mean over all sequences of the step."""
        if not self._weights:
            return
        for facts in step.whole[step.ranks.rank :: step.ranks.size]:
            found = self._method.penalties(facts.sequence_id)
            loss = torch.stack([weight * found[name] for name, weight in self._weights.items()]).sum()
            step.backward(loss / len(step.whole))


class FittedModule(GausSimModule):
    """Fits a method: every optimiser step is one rollout of a batch, drawn and compared as its stage says.

    With ``data.batch_size`` 1 the fits of the sequences do not see each other (their gradients are clipped one by
    one), but for what the method shares between the sequences of an object.
    """

    def __init__(
        self,
        *,
        method: FittedMethod,
        plan: FitPlan,
        renderer: Renderer,
        explosion: float = 3.0,
        supervision: Supervision | None = None,
        seed: int = 0,
    ) -> None:
        """Takes everything it works with.

        Args:
            method: what is fitted.
            plan: its stages.
            renderer: draws the predictions.
            explosion: a rollout ends where a kernel is further than this from rest [diagonals of the scene].
            supervision: what predictions are compared with; the images when None. Other supervision has its own loss.
            seed: of the order of training.

        Raises:
            ConfigError: a stage names what the method does not have.
        """
        groups = method.parameter_groups()
        penalties = sorted(method.penalties(0)) if any(s.penalties for _, s in plan.order) else []
        plan.check(groups, penalties)
        super().__init__(
            model=Sequences(method),
            initial_states=None,
            scene_of_sequence=method.scene_of_sequence,
            renderer=renderer,
            objective=Objective(explosion=explosion),
            supervision=supervision,
            seed=seed,
            fraction_every=0,
        )
        self.plan, self.made = plan, dict.fromkeys((name for name, _ in plan.order), 0.0)
        self.stage = ""
        self._warned = True  # a first stage begins at rest, and the warning's advice is about other settings
        self._explosion = explosion

    @property
    def method(self) -> FittedMethod:
        """What is fitted."""
        return cast(Sequences, self.model).fitted

    @property
    def method_name(self) -> str:
        """The method's own."""
        return self.method.name

    @property
    def footnotes(self) -> dict[str, Any]:
        """What the method says of itself, and what the fit cost."""
        return {**super().footnotes, "extrapolates": self.method.extrapolates}

    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a sequence."""
        rest = self.method.scenes[self.scene_of_sequence[sequence_id]].means
        with torch.no_grad():
            return FittedDynamics(self.method, sequence_id).rollout(SimState(rest, rest), steps)

    def notes(self) -> list[str]:
        """What a reader of the figures must know: of the method, of stages that were cut short, and the fit's cost."""
        notes = list(self.method.notes())
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
        return notes + super().notes() if self.plan.order else notes

    # ------------------------------------------------------------------------------------------------ one step

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """The method's parameters."""
        return cast(Sequences, self.model).parameter_groups()

    def configure_optimizers(self) -> Optimizer | None:  # type: ignore[override]
        """One optimiser over the groups of the method; stages set their rates."""
        missing = {id(p) for p in self.parameters()} - {id(p) for own in self.groups().values() for p in own}
        if missing:
            raise ConfigError(f"{self.method.name}: {len(missing)} parameters in no group of parameter_groups().")
        return self.plan.build(self.groups())

    def initial(self, samples: Sequence[SequenceSample], batch: Any) -> SimState:
        """Frame 0 of every sequence, as the method has it."""
        return Carried.of([self.method.begin(s.sequence_id) for s in samples])

    def _set_rates(self, optimizer: Any, batch_idx: int) -> float:
        """Enters the stage of the epoch and sets its rates; returns the largest."""
        batches = max(1.0, float(self.trainer.num_training_batches))
        begun = self._staged().position
        name, _, _ = self.plan.place(begun)
        stage, done = self._enter(name), batch_idx / batches
        self.made[name] += self.plan.shows / batches
        iteration = self.plan.place(begun)[2] + done * self.plan.shows
        for group in optimizer.optimizer.param_groups:
            group["lr"] = stage.rate(group["name"], iteration)
            for parameter in group["params"]:
                parameter.requires_grad_(group["name"] in stage.rates)
        return max(stage.rate(group, iteration) for group in stage.rates)

    def _enter(self, name: str) -> Stage:
        """Makes a stage's loss the loss of the module; the baselines are measured by it anew."""
        stage = dict(self.plan.order)[name]
        if name != self.stage:
            if self.stage:
                self.baselines = Baselines(self.supervision)
            self.stage = name
        self.images.loss = stage.loss
        self.objective = Objective(
            image=stage.loss, explosion=self._explosion, backprop_steps=stage.backprop_steps, static_weight=0.0
        )
        self.settings = OptimizerSettings(network_lr=1.0, clip_norm=stage.clip_norm)  # rates are the stages' own
        return stage

    def accumulate(self, loss: Tensor) -> None:
        """Nothing where nothing learns: behind the first frame, an initial velocity when gradients stop there."""
        if loss.requires_grad:
            super().accumulate(loss)

    def terms(self) -> Sequence[Term]:
        """The stage's penalties."""
        return (Penalties(self.method, dict(self.plan.order)[self.stage].penalties),)

    def network(self) -> list[nn.Parameter]:
        """None: a method has no network that sequences share."""
        return []

    @staticmethod
    def defers(device: torch.device) -> bool:
        """Never: after an explosion there is no state of rest to go on from."""
        return False

    # ------------------------------------------------------------------------------------------------ stages

    def _staged(self) -> StagedCurriculum:
        curriculum = cast(Any, self.trainer).datamodule.curriculum
        assert isinstance(curriculum, StagedCurriculum)
        return curriculum

    def on_train_epoch_end(self) -> None:
        """Forms the epoch's means and fixes what the next epoch learns: the next iterations, or what the clock says."""
        super().on_train_epoch_end()
        self._staged().enter(max(self._staged().position + 1, self.time_fraction * self.plan.epochs))
        if self._staged().position >= self.plan.epochs:
            self.trainer.should_stop = True

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds where in the plan the fit is."""
        super().on_save_checkpoint(checkpoint)
        place = self._staged().state_dict() if self.plan.order else {}
        own = {"place": place, "stage": self.stage, "made": dict(self.made)}
        checkpoint["gausim"]["plan"] = own

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restores it."""
        super().on_load_checkpoint(checkpoint)
        if self.plan.order:
            self._staged().load_state_dict(checkpoint["gausim"]["plan"]["place"])

    def take_notes(self, checkpoint: Mapping[str, Any]) -> None:
        """What a checkpoint says of the stages that were made, too."""
        super().take_notes(checkpoint)
        own = checkpoint["gausim"]["plan"]
        self.stage = own["stage"]
        self.made.update(own["made"])
