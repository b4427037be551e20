"""Parts of training that an optimiser step needs, without a trainer."""

from collections.abc import Sequence
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, Hands, Renderer, Trajectory
from gausim.data.dataset import SequenceSample
from gausim.losses.objective import Objective
from gausim.nn.mode import evaluating
from gausim.render.draw import draw
from gausim.training.contracts import Simulator
from gausim.training.exchange import Exchange
from gausim.training.graphed import GraphedRollouts
from gausim.training.method import SharedSimulator
from gausim.training.optimizers import OptimizerSettings
from gausim.training.ranks.ranks import Ranks
from gausim.training.rollout import States, windows
from gausim.training.statistics import Baselines, SequenceBaseline
from gausim.training.supervision.images import ImageSupervision, Supervision


class Learner(nn.Module):
    """A method with its objective, supervision, optimiser settings and baseline metrics.

    Attributes:
        images: supervision by images, also used to render predictions.
        diagonals: diagonals of the scenes [scene units].
        barren: number of successive steps without a usable stretch.
        shown: sequences of the last step.
    """

    def __init__(
        self,
        *,
        method: SharedSimulator,
        renderer: Renderer,
        objective: Objective | None = None,
        optimizer: OptimizerSettings | None = None,
        supervision: Supervision | None = None,
    ) -> None:
        super().__init__()
        self.method, self.model, self.initial_states = method, method.model, method.initial_states
        self.objective = objective or Objective()
        self.settings = optimizer or OptimizerSettings()
        self.graphs = GraphedRollouts(method.model)
        self.diagonals = [scene.diagonal for scene in self.simulator.scenes]
        self.images = ImageSupervision(self.simulator.scenes, renderer, self.objective.image)
        self.images.begins = self._begins
        self.supervision: Supervision = self.images if supervision is None else supervision
        self.baselines = Baselines(self.supervision)
        self.ranks, self.barren, self.shown = Ranks(), 0, 0
        self.exchange = Exchange(self.ranks, method.model)

    @property
    def simulator(self) -> Simulator:
        """The model, typed as a simulator."""
        return cast(Simulator, self.model)

    @property
    def renderer(self) -> Renderer:
        """The renderer of predictions."""
        return self.images.renderer

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by group; each group has a learning rate."""
        return self.method.groups()

    def configure_optimizers(self) -> Any:
        """One optimiser over all groups.

        Raises:
            ConfigError: a parameter is in no group.
        """
        grouped = {id(p) for members in self.groups().values() for p in members}
        missing = [n for n, p in self.named_parameters() if p.requires_grad and id(p) not in grouped]
        if missing:
            raise ConfigError(f"optimizer: parameters in no group: {missing}. Add them to parameter_groups().")
        return self.method.build(self.settings)

    def accumulate(self, loss: Tensor) -> None:
        """Adds the gradients of a loss, if there are trainable parameters."""
        if loss.requires_grad:
            loss.backward()

    def baseline(self, sample: SequenceSample) -> SequenceBaseline:
        """Baseline metrics of a sample's sequence, for at least the sample's frames."""
        return self.baselines.of(sample, self.simulator.batch([sample.scene_id]).rest)

    @torch.no_grad()
    def _begins(self, sample: SequenceSample) -> Float[Tensor, "K 3"] | None:
        if not self.simulator.scenes[sample.scene_id].surroundings.free:
            return None
        batch = self.simulator.batch([sample.scene_id])
        return self.method.initial([sample], batch).positions

    def rest_loss(self, sample: SequenceSample) -> float:
        """Mean loss of the rest state on the frames of a sample: the unit of penalties."""
        losses = self.baseline(sample).static[: sample.steps]
        return sum(losses) / len(losses)

    def hands(self, samples: Sequence[SequenceSample]) -> list[Hands | None] | None:
        """Poses of the hands of each sample's sequence; None where no sample has any."""
        found = [self.method.hands(sample.sequence_id) for sample in samples]
        return found if any(own is not None for own in found) else None

    @torch.no_grad()
    def predict(self, sequence_id: int, steps: int) -> Trajectory:
        """Frames 0..``steps`` of a training sequence.

        Raises:
            DivergenceError: a position is not finite; names the frame.
        """
        return self.method.predict(sequence_id, steps)

    @torch.no_grad()
    def predict_images(self, sample: SequenceSample) -> Float[Tensor, "F V H W 3"]:
        """Images of frames 0..T of one training sequence, in evaluation mode."""
        batch = self.simulator.batch([sample.scene_id])
        appearance, units = self.images.appearances.of(sample.scene_id, batch.rest), batch.members[0].unit_of_kernel
        frames = [self.images.rest_image(sample, batch.rest).rgb]
        with evaluating(self):
            initial, hands = self.method.initial([sample], batch), self.hands([sample])
            for _, made in windows(self.simulator, batch, initial, sample.steps, 1, hands=hands):
                frames.append(draw(self.renderer, appearance, *States.of(made), units, sample.cameras).rgb)
        return torch.cat(frames)
