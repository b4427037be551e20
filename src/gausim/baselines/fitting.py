"""Fits of a method to its sequences, stage by stage: a plain loop with checkpoints."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from gausim.baselines.fitted import Fitted, FittedDynamics
from gausim.baselines.stages import FitPlan, Stage
from gausim.core import ConfigError, DivergenceError, Renderer, SimState, Trajectory
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SampleKey, SequenceSample
from gausim.data.sampler import SequenceBatchSampler
from gausim.losses.image import ImageLoss
from gausim.models.hierarchy.batch import Member
from gausim.runs.checkpoint import AtomicCheckpointIO, check_scenes, fingerprints, read_checkpoint
from gausim.runs.cost import TrainingCost
from gausim.runs.names import EPOCHS, LAST_CHECKPOINT
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import TrainingPlan
from gausim.training.rollout import States, check_reach, describe, reach
from gausim.training.statistics import SequenceBaseline, relative
from gausim.training.supervision.images import ImageSupervision
from gausim.training.table import Table, short
from gausim.training.trainer import TrainerSettings

COLUMNS = (
    "epoch", "step", "stage", "steps", "loss_image", "ratio_static", "excess_static", "ratio_first", "motion_energy",
    "exploded", "lr", "seconds",
)  # fmt: skip
# Seconds after which a checkpoint is saved within an epoch.
SAVED_AFTER = 60.0


@dataclass(eq=False)
class OneSequence:
    """A batch of one sequence (see :class:`gausim.training.contracts.SceneBatch`)."""

    rest: Float[Tensor, "K 3"]
    members: tuple[Any, ...]


class FittedModule(nn.Module):
    """A fitted method with its stages, and what has been done of them.

    Attributes:
        model: the fitted method.
        method_name: its row in tables.
        scenes: the rest scenes; their index is the ``scene_id`` of samples.
        renderer: the renderer of its states.
        initial_states: None; they are parameters of the method.
    """

    initial_states = None

    def __init__(self, model: Fitted, plan: FitPlan, *, renderer: Renderer, explosion: float) -> None:
        """A rollout ends where a kernel is further than ``explosion`` from rest [diagonals of the scene]."""
        super().__init__()
        penalties = sorted(model.penalties(0)) if any(s.penalties for _, s in plan.order) else []
        plan.check(model.parameter_groups(), penalties)
        self.model, self.plan = model, plan
        self.method_name, self.scenes = model.name, model.scenes
        self.renderer, self.explosion = renderer, explosion
        self.images = ImageSupervision(model.scenes, renderer, ImageLoss())
        self.images.begins = self._begins
        self.global_step = 0  # optimiser steps so far
        self.made, self.cost = dict.fromkeys((name for name, _ in plan.order), 0.0), TrainingCost()

    @property
    def footnotes(self) -> dict[str, Any]:
        """Whether the method extrapolates, notes on its figures, and the cost of the fit."""
        fit = self.cost.summary() if self.cost.seconds else None
        return {"extrapolates": self.model.extrapolates, "notes": self.notes(), "fit": fit}

    def notes(self) -> list[str]:
        """The method's notes, notes on shortened stages, and the cost of the fit, in sentences."""
        notes = list(self.model.notes())
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
        return notes + (self.cost.notes() if self.plan.order else [])

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by group."""
        return {name: list(members) for name, members in self.model.parameter_groups().items()}

    def dynamics(self, sequence_id: int) -> FittedDynamics:
        """The method on one of its sequences."""
        return FittedDynamics(self.model, sequence_id)

    @torch.no_grad()
    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a sequence.

        Raises:
            DivergenceError: a position is not finite; names the frame.
        """
        rest = self.scenes[self.model.scene_of_sequence[sequence_id]].means
        return self.dynamics(sequence_id).rollout(SimState(rest, rest), steps)

    def take_notes(self, checkpoint: Mapping[str, Any]) -> None:
        """Restores from a checkpoint what :attr:`footnotes` needs."""
        self.made.update(checkpoint["gausim"]["fit"]["made"])
        self.cost.load_state_dict(checkpoint["cost"])

    # ------------------------------------------------------------------------------------------------ one step

    def descend(self, sample: SequenceSample, stage: Stage, weight: float) -> tuple[list[list[float]], float]:
        """Rollout and backward passes of one sequence; returns the loss of each frame and the change of the images.

        ``weight`` is the sequence's part of the optimiser step. A stretch in which a kernel moves too far has no loss.

        Raises:
            DivergenceError: a value is not finite; names the sequence.
        """
        device = next(self.parameters()).device
        unit = self.model.unit_of_kernel(sample.scene_id).to(device)
        member = Member(sample.scene_id, slice(0, len(unit)), slice(0, int(unit.max()) + 1), unit)
        batch = OneSequence(self.scenes[sample.scene_id].means.to(device), (member,))
        compare, state = self.images.comparison([sample], batch), self.model.begin(sample.sequence_id)
        frames: list[list[float]] = []
        change, steps = 0.0, sample.steps
        length = min(steps, stage.backprop_steps) if stage.backprop_steps else steps
        for start in range(0, steps, length):
            state, made = (state.detach() if start else state), []
            for _ in range(min(length, steps - start)):
                state = self.model.advance(state)
                made.append(state)
            states = States.of(made)
            extent = reach(batch, [scene.diagonal for scene in self.scenes], states.positions).tolist()
            if check_reach(extent, start, [sample.facts]) > self.explosion:
                break
            losses, motion = compare(states, start)
            (weight / steps * losses.sum()).backward()
            frames += losses.tolist()
            change += float(motion)
        if stage.penalties:
            found = self.model.penalties(sample.sequence_id)
            penalty = torch.stack([factor * found[name] for name, factor in stage.penalties.items()]).sum()
            (weight * penalty).backward()
        if not all(abs(value) < float("inf") for row in frames for value in row):
            raise DivergenceError(describe(None, [sample.facts], sample.facts, "the image loss is not finite"))
        return frames, change

    def _begins(self, sample: SequenceSample) -> Float[Tensor, "K 3"] | None:
        if not self.scenes[sample.scene_id].surroundings.free:
            return None
        return self.model.begin(sample.sequence_id).positions.detach()


class Fit:
    """The loop of a fit, from its first or a saved step to its end."""

    def __init__(
        self, module: FittedModule, data: ReadyDataModule, plan: TrainingPlan, run_dir: Path, seed: int
    ) -> None:
        """``plan`` has the number of frames, the batch size and the time limit."""
        self.module, self.data, self.plan, self.stages, self.run_dir = module, data, plan, module.plan, run_dir
        groups = [{"params": own, "lr": 0.0, "name": name} for name, own in module.groups().items() if own]
        self.optimizer: Optimizer = (self.stages.optimizer or Adam)(groups)
        self.sampler = SequenceBatchSampler(len(data.index), plan=plan, seed=seed)
        self.epoch = self.batch = 0
        self.position, self.stage = 0.0, ""
        self.sums: list[Any] = []  # frames, change and steps of the sequences of this epoch
        self.baselines: dict[int, SequenceBaseline] = {}
        self.summary: dict[str, float] = {}

    def run(self) -> None:
        """Fits to the end of the stages or of the time, with a row of ``epochs.csv`` per epoch."""
        table = Table(self.run_dir / EPOCHS, "epoch", COLUMNS)
        table.resume_at(self.epoch)
        self.module.cost.begin()
        while self.position < self.stages.epochs:
            began = time.monotonic()
            self._epoch()
            done = self.plan.time_fraction(self.minutes)
            self.position = max(self.position + 1, done * self.stages.epochs)
            self.epoch, self.batch, self.sums = self.epoch + 1, 0, []
            seconds = time.monotonic() - began
            place = {"epoch": self.epoch, "step": self.module.global_step, "stage": self.stage, "seconds": seconds}
            table.append({name: short(value) for name, value in (place | self.summary).items()})
            said = f"T {self.summary['steps']:.0f}  loss/static {self.summary.get('excess_static', float('nan')):.3f}"
            print(f"epoch {self.epoch}  stage {self.stage}  {said}  {seconds:.1f} s", flush=True)
            self.save()

    @property
    def minutes(self) -> float:
        """Time so far by the clock of the plan [minutes]."""
        return self.module.cost.minutes(self.plan.clock) if self.plan.max_minutes is not None else 0.0

    def _epoch(self) -> None:
        """The rest of the current epoch: ``plan.shows`` iterations of every sequence."""
        name, stage, begun = self.stages.place(self.position)
        if name != self.stage:
            self.stage, self.baselines = name, {}
        self.module.images.loss = stage.loss
        steps = self.stages.steps(self.position, self.plan.t_max or 1)
        order, size = self.sampler.order(self.epoch), self.plan.batch_size or 1
        batches, saved = [order[i : i + size] for i in range(0, len(order), size)], time.monotonic()
        while self.batch < len(batches):
            rate = self._rates(stage, begun + self.batch / len(batches) * self.stages.shows)
            self._step(stage, [self.data.index[SampleKey(i, steps)] for i in batches[self.batch]])
            self.batch, self.module.global_step = self.batch + 1, self.module.global_step + 1
            self.module.made[name] += self.stages.shows / len(batches)
            self.summary = {"steps": float(steps), "lr": rate, **self._means(steps)}
            if self.plan.time_fraction(self.minutes) >= 1:
                break
            if time.monotonic() - saved > SAVED_AFTER:
                self.save()
                saved = time.monotonic()

    def _rates(self, stage: Stage, iteration: float) -> float:
        """Sets the learning rates, and what is trained; returns the largest rate."""
        for group in self.optimizer.param_groups:
            group["lr"] = stage.rate(group["name"], iteration)
            for parameter in group["params"]:
                parameter.requires_grad_(group["name"] in stage.rates)
        return max(stage.rate(name, iteration) for name in stage.rates)

    def _step(self, stage: Stage, samples: Sequence[SequenceSample]) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        for sample in samples:
            moved = sample.to(next(self.module.parameters()).device)
            frames, change = self.module.descend(moved, stage, 1 / len(samples))
            self._know(moved)
            self.sums.append([sample.sequence_id, frames, change])
        norms = OptimizerSettings(clip_norm=stage.clip_norm).clip(self.optimizer)
        wrong = [name for name, norm in norms.items() if not bool(torch.isfinite(norm))]
        if wrong:
            facts = [sample.facts for sample in samples]
            raise DivergenceError(describe(None, facts, None, f"the gradient of {wrong} is not finite"))
        self.optimizer.step()

    def _know(self, sample: SequenceSample) -> None:
        """Measures the loss of the rest state on the frames of a sample that were not measured before."""
        known = self.baselines.setdefault(sample.sequence_id, SequenceBaseline())
        known.extend(self.module.images, sample, self.module.scenes[sample.scene_id].means.to(sample.frames.device))

    def _means(self, steps: int) -> dict[str, float]:
        """Figures of this epoch: means over the sequences that were shown."""
        whole = [(i, frames, change) for i, frames, change in self.sums if frames]
        found = {"exploded": sum(len(frames) < steps for _, frames, _ in self.sums) / len(self.sums)}
        if not whole:
            return found
        rows: dict[str, list[float]] = {}
        for sequence, frames, change in whole:
            figures = relative(frames, change, [self.baselines[sequence]])
            figures["loss_image"] = sum(map(sum, frames)) / len(frames)
            for name, value in figures.items():
                rows.setdefault(name, []).append(value)
        return found | {name: sum(values) / len(values) for name, values in rows.items()}

    # ------------------------------------------------------------------------------------------------ checkpoints

    def save(self) -> None:
        """Writes ``last.ckpt``, from which the fit continues exactly."""
        own = {name: getattr(self, name) for name in ("epoch", "batch", "position", "stage", "sums", "summary")}
        known = {sequence: asdict(baseline) for sequence, baseline in self.baselines.items()}
        checkpoint = {
            "state_dict": self.module.state_dict(),
            "optimizer_states": [self.optimizer.state_dict()],
            "epoch": self.epoch,
            "global_step": self.module.global_step,
            "cost": self.module.cost.state_dict(),
            "gausim": {
                "scenes": fingerprints(self.module.scenes),
                "fit": {**own, "made": dict(self.module.made), "baselines": known},
            },
        }
        AtomicCheckpointIO().save_checkpoint(checkpoint, self.run_dir / LAST_CHECKPOINT)

    def resume(self, path: Path) -> None:
        """Continues from a checkpoint.

        Raises:
            RunError: it is damaged, or of other scenes.
        """
        checkpoint = read_checkpoint(path)
        check_scenes(checkpoint, self.module.scenes, str(path))
        self.module.load_state_dict(checkpoint["state_dict"])
        self.optimizer.load_state_dict(checkpoint["optimizer_states"][0])
        own = dict(checkpoint["gausim"]["fit"])
        self.module.take_notes(checkpoint)
        self.baselines = {int(i): SequenceBaseline(**known) for i, known in own.pop("baselines").items()}
        own.pop("made")
        self.module.global_step = checkpoint["global_step"]
        for name, value in own.items():
            setattr(self, name, value)


def begin(module: FittedModule, data: ReadyDataModule, config: Mapping[str, Any], *, resumed: bool) -> None:
    """Refuses to start from another run."""
    if config["init_from"] is not None or config["freeze"] is not None:
        raise ConfigError(
            f"init_from, freeze: {module.method_name} is fitted to its own sequences and takes nothing over. Leave "
            "both null, and train on the new sequences."
        )


def course(module: FittedModule, data: ReadyDataModule, config: Mapping[str, Any]) -> list[str]:
    """Stages of the fit, and notes on the method."""
    lines = [f"{name}: {stage.iterations} iterations per sequence" for name, stage in module.plan.order]
    return [*lines, *(f"note: {note}" for note in module.model.notes())]


def fit(
    module: FittedModule, data: ReadyDataModule, settings: TrainerSettings, run_dir: Path, *, seed: int,
    resume: Path | None, loggers: Sequence[Any],
) -> dict[str, Any]:  # fmt: skip
    """Fits a method on one rank, or continues from a checkpoint; returns facts about the fit. Nothing is logged.

    Raises:
        ConfigError: there are several ranks.
        RunError: the checkpoint does not fit.
        DivergenceError: a value is not finite.
    """
    if settings.size != 1:
        raise ConfigError(f"trainer.devices: {module.method_name} is fitted by one rank; expected 1.")
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    module.to("cuda" if settings.on_gpu else "cpu")
    if not module.plan.order:  # nothing is learned
        checkpoint = {"state_dict": module.state_dict(), "gausim": {"scenes": fingerprints(module.scenes),
                      "fit": {"made": {}}}, "cost": module.cost.summary(), "epoch": 0, "global_step": 0}  # fmt: skip
        AtomicCheckpointIO().save_checkpoint(checkpoint, run_dir / LAST_CHECKPOINT)
        return {"epochs": 0, "optimizer_steps": 0, "last_epoch": {}, "notes": module.notes()}
    loop = Fit(module, data, cast(TrainingPlan, data.plan), run_dir, seed)
    if resume is not None:
        loop.resume(resume)
    loop.run()
    figures = {"epochs": loop.epoch, "optimizer_steps": module.global_step, "last_epoch": loop.summary}
    return {**figures, "notes": module.notes()}
