"""The LightningModule that learns dynamics from images (METHOD section 4)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.optim import Optimizer

from gausim.core import ConfigError, DivergenceError, Renderer, SimState
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.data.sampler import hash_seed
from gausim.engine.checkpoint import WeightAverage, check_scenes, fingerprints
from gausim.engine.contracts import InitialVelocities, SceneBatch, Simulator
from gausim.engine.contracts import Step as PredictedStep
from gausim.engine.curriculum import LossGatedCurriculum
from gausim.engine.optim import OptimizerSettings
from gausim.engine.reference import Yardsticks
from gausim.engine.rollout import Looks, UnitNoise, describe, draw_steps, furthest, group_views, windows
from gausim.losses.objective import Objective
from gausim.losses.static import static_loss

# Below this share of the true motion energy a prediction counts as collapsed to the rest state.
COLLAPSED = 0.05
# Optimiser steps before a collapse is worth a warning: initial states begin at rest, so every run begins static.
COLLAPSE_AFTER = 100
# Batches in a row whose rollout explodes before anything can be learned from it; then training has diverged.
BARREN_BATCHES = 20


@dataclass
class Tally:
    """What one optimiser step found, on the device until it is read in one go.

    Attributes:
        images: image loss per predicted step and sequence.
        momentum: momentum loss per predicted step.
        motion: squared change of the predicted images, summed over the batch.
        static: the static loss, if this batch carries it.
        share: the momentum loss's share of the network's gradient, where it was measured.
        ended: predicted steps; fewer than T where the rollout exploded.
    """

    images: list[Tensor] = field(default_factory=list)
    momentum: list[Tensor] = field(default_factory=list)
    motion: list[Tensor] = field(default_factory=list)
    static: Tensor | None = None
    share: Tensor | None = None
    ended: int = 0


class GausSimModule(LightningModule):
    """Trains a simulator: rollout as one graph, drawing, losses, one optimiser step per batch.

    Backward runs after every stretch through which gradients flow, so that memory does not grow with T.
    """

    def __init__(
        self,
        *,
        model: nn.Module,
        initial_states: nn.Module,
        scene_of_sequence: Sequence[int],
        renderer: Renderer,
        objective: Objective | None = None,
        optimizer: OptimizerSettings | None = None,
        seed: int = 0,
        share_every: int = 50,
    ) -> None:
        """Takes everything it works with; it builds nothing.

        Args:
            model: the simulator (see :class:`gausim.engine.contracts.Simulator`).
            initial_states: one parameter per training sequence, in their order.
            scene_of_sequence: the scene of each training sequence.
            renderer: draws the predictions.
            objective: what is minimised; METHOD's when None.
            optimizer: who learns how fast; METHOD's when None.
            seed: of the static loss's draws and the input noise, together with the step's number.
            share_every: optimiser steps between measurements of the momentum loss's share of the gradient; 0 is never.

        Raises:
            ConfigError: the initial states do not fit the sequences.
        """
        super().__init__()
        self.automatic_optimization = False
        self.model, self.initial_states = model, initial_states
        self.renderer = renderer
        self.objective = objective if objective is not None else Objective()
        self.settings = optimizer if optimizer is not None else OptimizerSettings()
        self.scene_of_sequence = tuple(scene_of_sequence)
        self.seed, self.share_every = seed, share_every
        if len(list(initial_states.parameters())) != len(self.scene_of_sequence):
            raise ConfigError(
                f"initial states: {len(list(initial_states.parameters()))} parameters for "
                f"{len(self.scene_of_sequence)} sequences; expected one each."
            )
        self.diagonals = [scene.diagonal for scene in self.simulator.scenes]
        self.looks = Looks(self.simulator.scenes)
        self.yardsticks = Yardsticks(renderer, self.objective.image)
        self.average = WeightAverage(self.settings.ema_decay)
        self.summary: dict[str, float] = {}
        self.last_stats: dict[str, float] = {}
        self.time_fraction = 0.0
        self._sums: dict[str, list[float]] = {}
        self._warned, self._barren = False, 0

    @property
    def simulator(self) -> Simulator:
        """The model, as what it can do."""
        return cast(Simulator, self.model)

    def configure_optimizers(self) -> Optimizer:
        """One optimiser over the groups of the model and the initial states."""
        groups = {**self.simulator.parameter_groups(), "initial": list(self.initial_states.parameters())}
        grouped = {id(p) for members in groups.values() for p in members}
        missing = [n for n, p in self.named_parameters() if p.requires_grad and id(p) not in grouped]
        if missing:
            raise ConfigError(f"optimizer: parameters in no group: {missing}. Add them to parameter_groups().")
        return self.settings.build(groups)

    # ------------------------------------------------------------------------------------------------ one step

    def training_step(self, samples: list[SequenceSample], batch_idx: int) -> None:
        """Rolls the batch forward, draws it, and makes one step of the optimiser."""
        optimizer = cast(Any, self.optimizers())
        factor = self._set_rates(optimizer, batch_idx)
        optimizer.zero_grad(set_to_none=True)
        draws = torch.Generator().manual_seed(hash_seed(self.seed, self.global_step))
        tally = self._rollout(samples, draws)
        self._static(samples, draws, tally)
        norms = self.settings.clip(optimizer.optimizer)
        stats = self._read(samples, tally, norms)
        optimizer.step()
        self.average.update(self)
        self._record({**stats, "lr": self.settings.network_lr * factor}, len(samples))

    def _set_rates(self, optimizer: Any, batch_idx: int) -> float:
        batches, epochs = self.trainer.num_training_batches, self.trainer.max_epochs or 1
        done = self.current_epoch + batch_idx / max(1.0, float(batches))
        return self.settings.set_rates(optimizer.optimizer, max(done, self.time_fraction * epochs), epochs)

    def _rollout(self, samples: list[SequenceSample], draws: torch.Generator) -> Tally:
        steps = samples[0].steps
        if any(s.steps != steps for s in samples):
            raise ConfigError(f"a batch needs sequences of equal length, got {[s.steps for s in samples]} steps.")
        batch = self.simulator.batch([s.scene_id for s in samples])
        groups = group_views(samples)
        truths = [composite(s.frames[1:])[0] for s in samples]
        before: dict[int, Tensor] = {}
        noise = None
        if self.objective.input_noise > 0:
            deviations = [self.objective.input_noise * d for d in self.diagonals]
            noise = UnitNoise(batch, self.simulator.scenes, deviations, draws)
        tally, length = Tally(), self.objective.window(steps)
        for start, made in windows(self.simulator, batch, self.initial(samples, batch), steps, length, noise):
            if furthest(batch, self.diagonals, made, start, samples) > self.objective.explosion:
                break
            losses = torch.zeros(len(made), len(samples), device=batch.rest.device)
            columns: list[Tensor] = [losses[:, 0]] * len(samples)
            for number, group in enumerate(groups):
                look = self.looks.of(group.scene_id, batch.rest)
                images = draw_steps(self.renderer, look, group, batch, made)
                target = torch.stack([truths[i][start : start + len(made)] for i in group.members], 1)
                values = self.objective.image(images.flatten(0, 1), target.flatten(0, 1)).reshape(len(made), -1)
                for place, i in enumerate(group.members):
                    columns[i] = values[:, place]
                if number not in before:
                    before[number] = self._rest_images(samples, group.members, batch)
                tally.motion.append(_motion(before[number], images.detach()))
                before[number] = images[-1].detach()
            self._descend(torch.stack(columns, 1), made, steps, tally, measure=start == 0)
        return tally

    def _descend(self, losses: Tensor, made: list[PredictedStep], steps: int, tally: Tally, *, measure: bool) -> None:
        """Backward of one stretch; the mean over steps and sequences, whatever the stretch's length."""
        per = 1.0 / (steps * losses.shape[1])
        momentum = torch.stack([step.momentum for step in made])
        images_term = self.objective.image_weight * per * losses.sum()
        momentum_term = self.objective.momentum_weight * per * momentum.sum()
        weighted = momentum_term.requires_grad and self.objective.momentum_weight > 0
        if measure and weighted and self.share_every and self.global_step % self.share_every == 0:
            tally.share = self._share(images_term, momentum_term)
        self.manual_backward(images_term + momentum_term if weighted else images_term)
        tally.images.extend(losses.detach())
        tally.momentum.extend(momentum.detach())
        tally.ended += len(made)

    def _share(self, images: Tensor, momentum: Tensor) -> Tensor:
        """Norm of the momentum loss's gradient of the network over the sum of both norms."""
        network = self.simulator.parameter_groups()["network"]
        norms = []
        for term in (images, momentum):
            grads = torch.autograd.grad(term, network, retain_graph=True, allow_unused=True)
            norms.append(torch.nn.utils.get_total_norm([g for g in grads if g is not None]))
        return norms[1] / (norms[0] + norms[1]).clamp_min(1e-30)

    def _static(self, samples: list[SequenceSample], draws: torch.Generator, tally: Tally) -> None:
        chance = self.objective.static_chance(samples[0].steps)
        if float(torch.rand((), generator=draws)) >= chance:
            return
        scene_ids = sorted({s.scene_id for s in samples})
        batch = self.simulator.batch(scene_ids)
        step = self.simulator.step(batch, SimState(batch.rest, batch.rest))
        loss = static_loss(step.positions, batch.rest) / len(scene_ids)
        if loss.requires_grad:
            self.manual_backward(self.objective.static_weight * loss)
        tally.static = loss.detach()

    # ------------------------------------------------------------------------------------------------ states, images

    def initial(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> SimState:
        """x_0 (the rest state) and the trainable x_{-1} of the sequences of a batch."""
        states = cast(InitialVelocities, self.initial_states)
        previous = torch.cat([states.previous(s.sequence_id) for s in samples])
        return SimState(batch.rest, previous.to(batch.rest))

    def _rest_images(
        self, samples: Sequence[SequenceSample], members: Sequence[int], batch: SceneBatch
    ) -> Float[Tensor, "S V H W 3"]:
        images = []
        for i in members:
            look = self.looks.of(samples[i].scene_id, batch.rest)
            rest = batch.rest[batch.members[i].kernels]
            images.append(self.yardsticks.rest_image(samples[i], look, rest))
        return torch.stack(images)

    @torch.no_grad()
    def predict_images(self, sample: SequenceSample) -> Float[Tensor, "F V H W 3"]:
        """Images of frames 0..T of one training sequence, in evaluation mode."""
        was_training = self.training
        self.eval()
        batch = self.simulator.batch([sample.scene_id])
        (group,) = group_views([sample])
        look = self.looks.of(sample.scene_id, batch.rest)
        frames = [self._rest_images([sample], [0], batch)]
        for _, made in windows(self.simulator, batch, self.initial([sample], batch), sample.steps, 1):
            frames.append(draw_steps(self.renderer, look, group, batch, made)[0])
        self.train(was_training)
        return torch.cat(frames)

    # ------------------------------------------------------------------------------------------------ numbers

    def _read(self, samples: list[SequenceSample], tally: Tally, norms: Mapping[str, Tensor]) -> dict[str, float]:
        """Fetches all numbers of the step at once, checks them and forms what is logged."""
        steps, count = samples[0].steps, len(samples)
        images = torch.stack(tally.images) if tally.images else torch.zeros(0, count)
        extra = [torch.stack([m for m in tally.motion]).sum() if tally.motion else torch.zeros(())]
        extra += [tally.static if tally.static is not None else torch.zeros(())]
        extra += [tally.share if tally.share is not None else torch.full((), -1.0)]
        parts = [images.flatten(), *(m.reshape(1) for m in (*tally.momentum, *extra, *norms.values()))]
        numbers = torch.cat([p.to(images.device, torch.float32) for p in parts]).tolist()
        table = [numbers[t * count : (t + 1) * count] for t in range(tally.ended)]
        rest = numbers[tally.ended * count :]
        momentum, (motion, static, share) = rest[: tally.ended], rest[tally.ended : tally.ended + 3]
        grads = dict(zip(norms, rest[tally.ended + 3 :], strict=True))
        self._guard(samples, table, momentum, static, grads)
        self._barren = 0 if table else self._barren + 1
        if self._barren >= BARREN_BATCHES:
            far = f"kernels moved beyond {self.objective.explosion} diagonals in {BARREN_BATCHES} batches in a row"
            raise DivergenceError(describe(0, samples, None, far))
        stats = {f"grad_{name}": value for name, value in grads.items()}
        if share >= 0:
            stats["momentum_share"] = share
        if tally.static is not None:
            stats["loss_static"] = static
        stats.update(steps=float(steps), exploded=float(tally.ended < steps))
        if table:
            stats["loss_momentum"] = sum(momentum) / (steps * count)
            stats["loss_image"] = sum(map(sum, table)) / (tally.ended * count)
            stats.update(self._compare(samples, table, motion))
        return stats

    def _compare(self, samples: list[SequenceSample], table: list[list[float]], motion: float) -> dict[str, float]:
        """The prediction's losses and motion against the static prediction's and the truth's."""
        batch = self.simulator.batch([s.scene_id for s in samples])
        floor = static = first = moved = 0.0
        for i, sample in enumerate(samples):
            look, rest = self.looks.of(sample.scene_id, batch.rest), batch.rest[batch.members[i].kernels]
            yard = self.yardsticks.of(sample, look, rest)
            floor += yard.floor * len(table)
            static += sum(yard.static[: len(table)])
            moved += sum(yard.motion[: len(table)])
            first += yard.static[0]
        loss = sum(map(sum, table))
        # Above the floor a static loss can be next to nothing in the first frames; the ratio must stay finite.
        above = max(static - floor, 1e-3 * static, 1e-12)
        return {
            "ratio_static": loss / max(static, 1e-12),
            "excess_static": (loss - floor) / above,
            "ratio_first": sum(table[0]) / max(first, 1e-12),
            "motion_energy": motion / max(moved, 1e-12),
        }

    def _guard(
        self,
        samples: list[SequenceSample],
        table: list[list[float]],
        momentum: list[float],
        static: float,
        grads: Mapping[str, float],
    ) -> None:
        for t, row in enumerate(table):
            for value, sample in zip(row, samples, strict=True):
                if not abs(value) < float("inf"):
                    raise DivergenceError(describe(t, samples, sample, f"the image loss is {value}"))
            if not abs(momentum[t]) < float("inf"):
                raise DivergenceError(describe(t, samples, None, f"the momentum loss is {momentum[t]}"))
        if not abs(static) < float("inf"):
            raise DivergenceError(describe(None, samples, None, f"the static loss is {static}"))
        for name, value in grads.items():
            if not abs(value) < float("inf"):
                raise DivergenceError(describe(None, samples, None, f"the gradient of group '{name}' is {value}"))

    def _record(self, stats: dict[str, float], weight: int) -> None:
        self.last_stats = stats
        for name, value in stats.items():
            entry = self._sums.setdefault(name, [0.0, 0.0])
            entry[0] += value * weight
            entry[1] += weight
        every = getattr(self.trainer, "log_every_n_steps", 0)
        if every and self.global_step % every == 0:
            for logger in self.trainer.loggers:
                logger.log_metrics({f"train/{k}": v for k, v in stats.items()}, step=self.global_step)

    def epoch_means(self) -> dict[str, float]:
        """Means over the sequences of the epoch so far."""
        return {name: total / weight for name, (total, weight) in self._sums.items() if weight}

    def on_train_epoch_start(self) -> None:
        """Starts the epoch's sums anew."""
        self._sums.clear()

    def on_train_epoch_end(self) -> None:
        """Forms the epoch's means, warns of a collapse and lets the curriculum look at the loss."""
        self.summary = self.epoch_means()
        row = {f"epoch/{name}": value for name, value in self.summary.items()}
        for logger in self.trainer.loggers:  # not log_dict: Lightning would write it after the epoch's checkpoint
            logger.log_metrics({"epoch": self.current_epoch, **row}, step=self.global_step)
        energy = self.summary.get("motion_energy")
        if energy is not None and energy < COLLAPSED and self.global_step >= COLLAPSE_AFTER and not self._warned:
            self._warned = True
            warnings.warn(
                f"the prediction has collapsed to the rest state: it moves with {100 * energy:.1f} % of the true "
                "motion energy. Let T grow more slowly (a loss-gated curriculum), raise optimizer.initial_lr or use "
                "loss.backprop_steps > 1.",
                stacklevel=2,
            )
        curriculum = self._curriculum()
        if curriculum is not None and "excess_static" in self.summary:
            curriculum.observe(self.summary["excess_static"])

    def _curriculum(self) -> LossGatedCurriculum | None:
        datamodule = getattr(self.trainer, "datamodule", None) if self._trainer is not None else None
        curriculum = getattr(datamodule, "curriculum", None)
        return curriculum if isinstance(curriculum, LossGatedCurriculum) else None

    # ------------------------------------------------------------------------------------------------ checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the scenes' fingerprints, the averaged weights, the curriculum's state and the epoch's numbers."""
        own: dict[str, Any] = {"scenes": fingerprints(self.simulator.scenes), "average": self.average.state_dict()}
        own["epoch"] = {"sums": self._sums, "summary": self.summary, "warned": self._warned, "barren": self._barren}
        own["yardsticks"] = self.yardsticks.state_dict()
        curriculum = self._curriculum()
        if curriculum is not None:
            own["curriculum"] = curriculum.state_dict()
        checkpoint["gausim"] = own

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses a checkpoint of other scenes; restores what :meth:`on_save_checkpoint` added.

        Raises:
            RunError: naming both scenes.
        """
        check_scenes(checkpoint, self.simulator.scenes, "the checkpoint")
        own = checkpoint["gausim"]
        self.average.load_state_dict(own["average"])
        epoch = own["epoch"]
        self._sums, self.summary = epoch["sums"], epoch["summary"]
        self._warned, self._barren = epoch["warned"], epoch["barren"]
        self.yardsticks.load_state_dict(own["yardsticks"])
        curriculum = self._curriculum()
        if curriculum is not None and "curriculum" in own:
            curriculum.load_state_dict(own["curriculum"])


def _motion(before: Tensor, images: Tensor) -> Tensor:
    """Squared change from image to image, (T, S, V, H, W, 3) after (S, V, H, W, 3), summed over everything."""
    return torch.diff(torch.cat([before[None], images]), dim=0).square().sum()
