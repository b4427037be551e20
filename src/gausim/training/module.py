"""The LightningModule that learns dynamics from images (METHOD section 4)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.optim import Optimizer

from gausim.core import ConfigError, Renderer, SimState, Trajectory
from gausim.data.dataset import SequenceSample
from gausim.data.sampler import hash_seed
from gausim.losses.objective import Objective
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.nn.mode import evaluating
from gausim.render.draw import draw
from gausim.runs.checkpoint import RESUME_FORMAT, WeightAverage, check_scenes, fingerprints
from gausim.runs.cost import TrainingCost
from gausim.runs.renamed import with_present_weights
from gausim.training import step
from gausim.training.baseline_metrics import Baselines, SequenceBaseline
from gausim.training.contracts import InitialVelocities, SceneBatch, Simulator
from gausim.training.exchange import Exchange
from gausim.training.optimizers import OptimizerSettings
from gausim.training.ranks.ranks import Ranks
from gausim.training.rollout import States, windows
from gausim.training.supervision.images import ImageSupervision, Supervision
from gausim.training.supervision.motion_tracks import TrackSupervision
from gausim.training.terms.free_motion import FreeMotion
from gausim.training.terms.mixing import MixingTerm
from gausim.training.terms.rest import RestTerm
from gausim.training.terms.term import Term

# Below this fraction of the true motion energy a prediction counts as collapsed to the rest state.
COLLAPSED = 0.05
# Optimiser steps before a collapse is worth a warning: initial states begin at rest, so every run begins static.
COLLAPSE_AFTER = 100


class GausSimModule(LightningModule):
    """Trains a simulator: rollout as one graph, drawing, losses, one optimiser step per batch.

    Backward runs after every stretch through which gradients flow, so that memory does not grow with T. Under several
    ranks each computes its part of the sequences; the sums of gradients, statistics and numbers over the ranks are
    those of one rank that computes them all.
    """

    def __init__(
        self,
        *,
        model: nn.Module,
        initial_states: nn.Module | None,
        scene_of_sequence: Sequence[int],
        renderer: Renderer,
        objective: Objective | None = None,
        optimizer: OptimizerSettings | None = None,
        supervision: Supervision | None = None,
        seed: int = 0,
        fraction_every: int = 50,
    ) -> None:
        """Takes everything it works with; it builds nothing.

        Args:
            model: the simulator (see :class:`gausim.training.contracts.Simulator`).
            initial_states: one parameter per training sequence, in their order; None where the model has its own.
            scene_of_sequence: the scene of each training sequence.
            renderer: draws the predictions, for training on images and for the pictures.
            objective: what is minimised; METHOD's when None.
            optimizer: who learns how fast; METHOD's when None.
            supervision: what predictions are compared with; the images when None.
            seed: of the static loss's draws and the input noise, together with the step's number.
            fraction_every: optimiser steps between measurements of how much of the gradient is of momentum; 0 is never.

        Raises:
            ConfigError: the initial states do not fit the sequences.
        """
        super().__init__()
        self.automatic_optimization = False
        self.model, self.initial_states = model, initial_states
        self.objective = objective if objective is not None else Objective()
        self.settings = optimizer if optimizer is not None else OptimizerSettings()
        self.scene_of_sequence = tuple(scene_of_sequence)
        self.seed, self.fraction_every = seed, fraction_every
        count = len(self.scene_of_sequence)
        if initial_states is not None and (own := len(list(initial_states.parameters()))) != count:
            raise ConfigError(f"initial states: {own} parameters for {count} sequences; expected one each.")
        self.free_motion = FreeMotion(model, self.objective)
        self.diagonals = [scene.diagonal for scene in self.simulator.scenes]
        self.images = ImageSupervision(self.simulator.scenes, renderer, self.objective.image)
        self.supervision = self.images if supervision is None else supervision
        self.baselines = Baselines(self.supervision)
        self.average = WeightAverage(self.settings.ema_decay)
        self.summary: dict[str, float] = {}
        self.last_stats: dict[str, float] = {}
        self.time_fraction, self.progress_limit = 0.0, 1.0
        self._sums: dict[str, list[float]] = {}
        self._warned, self.barren = False, 0
        self.ranks, self.shown, self.cost = Ranks(), 0, TrainingCost()
        self.exchange = Exchange(self.ranks, model)

    @property
    def method_name(self) -> str:
        """What the predictions are called in tables."""
        return "gausim"

    @property
    def footnotes(self) -> dict[str, Any]:
        """Whether the method extrapolates, what readers of its figures must know, and what training cost."""
        return {"extrapolates": True, "notes": self.notes(), "fit": self.cost.summary() if self.cost.seconds else None}

    def notes(self) -> list[str]:
        """What a reader of the figures must know, in sentences."""
        return self.cost.notes()

    @property
    def renderer(self) -> Renderer:
        """What draws the predictions."""
        return self.images.renderer

    @property
    def simulator(self) -> Simulator:
        """The model, as what it can do."""
        return cast(Simulator, self.model)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """All parameters by the name that tells how fast they learn."""
        assert self.initial_states is not None
        return {**self.simulator.parameter_groups(), "initial": list(self.initial_states.parameters())}

    def configure_optimizers(self) -> Optimizer:
        """One optimiser over the groups of the model and the initial states."""
        groups = self.groups()
        grouped = {id(p) for members in groups.values() for p in members}
        missing = [n for n, p in self.named_parameters() if p.requires_grad and id(p) not in grouped]
        if missing:
            raise ConfigError(f"optimizer: parameters in no group: {missing}. Add them to parameter_groups().")
        return self.settings.build({name: [p for p in own if p.requires_grad] for name, own in groups.items()})

    # ------------------------------------------------------------------------------------------------ one step

    def training_step(self, samples: list[SequenceSample], batch_idx: int) -> None:
        """Rolls the batch forward, draws it, and makes one step of the optimiser."""
        optimizer = cast(Any, self.optimizers())
        factor = self._set_rates(optimizer, batch_idx)
        draws = torch.Generator().manual_seed(hash_seed(self.seed, self.global_step))
        stats = self.optimise(samples, optimizer.optimizer, draws, optimizer.step)
        self._record({**stats, "lr": self.settings.network_lr * factor}, self.shown)

    def optimise(
        self,
        samples: list[SequenceSample],
        optimizer: Optimizer,
        draws: torch.Generator,
        advance: Callable[[], object] | None = None,
    ) -> dict[str, float]:
        """One step of the optimiser with all losses; works without a trainer, too.

        Args:
            samples: this rank's part of the batch; it may be empty where there are several.
            optimizer: from :meth:`configure_optimizers`.
            draws: of the static loss and the input noise.
            advance: makes the optimiser's step; its own ``step`` when None.

        Returns:
            What is logged of the step.

        Raises:
            DivergenceError: a number is not finite; no parameter has moved.
        """
        return step.optimise(self, samples, optimizer, draws, advance or optimizer.step)

    def terms(self) -> Sequence[Term]:
        """The static loss and the penalty on mode mixing."""
        return (
            RestTerm(self.simulator, self.objective, self.diagonals, self.images),
            MixingTerm(self.model, self.objective.mixing_weight),
        )

    def measures_fraction(self) -> bool:
        """Every so many steps: what momentum is of the network's gradient."""
        return bool(self.fraction_every) and self.global_step % self.fraction_every == 0

    def accumulate(self, loss: Tensor) -> None:
        """Adds the gradients of a loss, by the trainer where there is one."""
        if self._trainer is None:
            loss.backward()
        else:
            self.manual_backward(loss)

    def _set_rates(self, optimizer: Any, batch_idx: int) -> float:
        batches, epochs = self.trainer.num_training_batches, self.trainer.max_epochs or 1
        done = self.current_epoch + batch_idx / max(1.0, float(batches))
        done = min(max(done, self.time_fraction * epochs), self.progress_limit * epochs)
        return self.settings.set_rates(optimizer.optimizer, done, epochs)

    @staticmethod
    def defers(device: torch.device) -> bool:
        """Whether reading a number would make the host wait; such reads are put off to the step's end."""
        return device.type != "cpu"

    def network(self) -> list[nn.Parameter]:
        """Weights of the network that learn."""
        return [p for p in self.simulator.parameter_groups()["network"] if p.requires_grad]

    def baseline(self, sample: SequenceSample) -> SequenceBaseline:
        """What the rest state scores on a sample's sequence, for at least the sample's frames."""
        return self.baselines.of(sample, self.simulator.batch([sample.scene_id]).rest)

    def rest_loss(self, sample: SequenceSample) -> float:
        """What the rest state scores on the frames of a sample, their mean: the unit of penalties."""
        losses = self.baseline(sample).static[: sample.steps]
        return sum(losses) / len(losses)

    # ------------------------------------------------------------------------------------------------ states, images

    def initial(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> SimState:
        """x_0 (the rest state) and the trainable x_{-1} of the sequences of a batch."""
        states = cast(InitialVelocities, self.initial_states)
        previous = torch.cat([states.previous(s.sequence_id) for s in samples])
        return SimState(batch.rest, previous.to(batch.rest))

    @torch.no_grad()
    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a training sequence, from its own initial state, for all kernels of its scene.

        Raises:
            DivergenceError: a position is not finite; names the frame.
        """
        scene_id = self.scene_of_sequence[sequence_id]
        previous = cast(InitialVelocities, self.initial_states).previous(sequence_id)
        initial = SimState(self.simulator.scenes[scene_id].means.to(previous), previous)
        return SceneDynamics(cast(Any, self.model), scene_id).rollout(initial, steps)

    @torch.no_grad()
    def predict_images(self, sample: SequenceSample) -> Float[Tensor, "F V H W 3"]:
        """Images of frames 0..T of one training sequence, in evaluation mode."""
        batch = self.simulator.batch([sample.scene_id])
        look, units = self.images.looks.of(sample.scene_id, batch.rest), batch.members[0].unit_of_kernel
        frames = [self.images.rest_image(sample, batch.rest).rgb]
        with evaluating(self):
            for _, made in windows(self.simulator, batch, self.initial([sample], batch), sample.steps, 1):
                states = States.of(made).tensors()
                frames.append(draw(self.images.renderer, look, *states, units, sample.cameras).rgb)
        return torch.cat(frames)

    # ------------------------------------------------------------------------------------------------ numbers

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

    def note(self, name: str, value: float) -> None:
        """Adds a number of the epoch under way to its means."""
        self._sums[name] = [value, 1.0]

    def epoch_means(self) -> dict[str, float]:
        """Means over the sequences of the epoch so far."""
        return {name: total / weight for name, (total, weight) in self._sums.items() if weight}

    def on_train_start(self) -> None:
        """Counts the cost from here."""
        self.cost.begin()

    def on_train_epoch_start(self) -> None:
        """Starts the epoch's sums anew."""
        self._sums.clear()

    def on_train_epoch_end(self) -> None:
        """Forms the epoch's means and warns of a collapse."""
        self.summary = self.epoch_means()
        row = {f"epoch/{name}": value for name, value in self.summary.items()}
        for logger in self.trainer.loggers:  # not log_dict: Lightning would write it after the epoch's checkpoint
            logger.log_metrics({"epoch": self.current_epoch, **row}, step=self.global_step)
        energy = self.summary.get("motion_energy")
        if energy is not None and energy < COLLAPSED and self.global_step >= COLLAPSE_AFTER and not self._warned:
            self._warned = True
            warnings.warn(
                f"the prediction has collapsed to the rest state: it moves with {100 * energy:.1f} % of the true "
                "motion energy. Let T grow more slowly (data.curriculum.epochs_per_increase), raise "
                "optimizer.initial_lr or use loss.backprop_steps > 1.",
                stacklevel=2,
            )

    # ------------------------------------------------------------------------------------------------ checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the scenes' fingerprints, the averaged weights and the epoch's numbers."""
        own: dict[str, Any] = {"format": RESUME_FORMAT, "scenes": fingerprints(self.simulator.scenes)}
        own["average"] = self.average.state_dict()
        own["epoch"] = {"sums": self._sums, "summary": self.summary, "warned": self._warned, "barren": self.barren}
        own["baselines"] = self.baselines.state_dict()
        if isinstance(self.supervision, TrackSupervision):
            own["tracks"] = self.supervision.state_dict()
        checkpoint["gausim"], checkpoint["cost"] = own, self.cost.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses a checkpoint of other scenes; restores what :meth:`on_save_checkpoint` added.

        Raises:
            RunError: naming both scenes.
        """
        check_scenes(checkpoint, self.simulator.scenes, "the checkpoint")
        checkpoint["state_dict"] = with_present_weights(checkpoint["state_dict"])
        self.take_notes(checkpoint)
        own = checkpoint["gausim"]
        self.average.load_state_dict({**own["average"], "values": with_present_weights(own["average"]["values"])})
        epoch = own["epoch"]
        self._sums, self.summary = epoch["sums"], epoch["summary"]
        self._warned, self.barren = epoch["warned"], epoch["barren"]
        self.baselines.load_state_dict(own.get("baselines") or own["yardsticks"])
        if isinstance(self.supervision, TrackSupervision):
            self.supervision.load_state_dict(own.get("tracks", {}))

    def take_notes(self, checkpoint: Mapping[str, Any]) -> None:
        """What a checkpoint says of its training, for :attr:`footnotes`."""
        if "cost" in checkpoint:  # not in those of earlier versions
            self.cost.load_state_dict(checkpoint["cost"])
