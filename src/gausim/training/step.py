"""One optimiser step: inputs, rollout, loss terms, backward passes, update."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.optim import Optimizer

from gausim.core import ConfigError, DivergenceError, Frame, SimState
from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.losses.objective import static_loss
from gausim.training.contracts import SceneBatch
from gausim.training.learner import Learner
from gausim.training.ranks.ranks import interleave
from gausim.training.rollout import States, check_reach, describe, reach, windows
from gausim.training.statistics import Measured, Statistics

# Successive batches whose rollouts explode in the first stretch, after which training counts as diverged.
BARREN_BATCHES = 20


class OptimiserStep(Learner):
    """A learner with its optimiser step (METHOD section 4)."""

    def optimise(
        self,
        samples: list[SequenceSample],
        optimizer: Optimizer,
        draws: torch.Generator,
        advance: Callable[[], object] | None = None,
    ) -> dict[str, float]:
        """One optimiser step with all losses; returns its logged metrics.

        ``samples`` are this rank's part of the batch, which may be empty with several ranks; ``draws`` generates the
        random numbers of the step. ``advance`` calls the optimiser, where its ``step`` alone is not enough.

        Raises:
            DivergenceError: a value is not finite; the parameters are unchanged.
        """
        optimizer.zero_grad(set_to_none=True)
        whole = interleave(self.ranks.gather([sample.facts for sample in samples]))
        self.exchange.begin(lambda: self._see_first_frame(samples))
        statistics = self.roll_out(samples, whole, draws)
        statistics.static = self._static_loss(samples, whole, draws)
        self.exchange.step([p for p in self.parameters() if p.requires_grad])
        stats = self._stats(samples, whole, statistics.fetch(self.settings.clip(optimizer)))
        self.exchange.absorb()
        (advance or optimizer.step)()
        self.shown = len(whole)
        return stats

    @torch.no_grad()
    def _see_first_frame(self, samples: list[SequenceSample]) -> None:
        """Initialises the input statistics of a new model with the first frame of its first batch."""
        if samples:
            batch, hands = self.simulator.batch([s.scene_id for s in samples]), self.hands(samples)
            for _ in windows(self.simulator, batch, self.method.initial(samples, batch), 1, 1, hands=hands):
                pass

    def roll_out(self, samples: list[SequenceSample], whole: list[SampleFacts], draws: torch.Generator) -> Statistics:
        """Predicts the batch with a backward pass after each stretch, so that memory does not grow with T.

        A rollout ends before the stretch in which a kernel moves too far from rest; that stretch has no loss.
        """
        steps, objective, statistics = whole[0].steps, self.objective, Statistics()
        if any(s.steps != steps for s in whole):
            raise ConfigError(f"a batch needs sequences of equal length, got {[s.steps for s in whole]} steps.")
        length, weight = objective.window(steps), 1 / (steps * len(whole))
        unit = self._momentum_unit(samples)
        if not samples:  # takes part in the ranks' decision on where the rollout ends
            any(self._explodes(None, None, start, whole) for start in range(0, steps, length))
            return statistics
        batch, hands = self.simulator.batch([s.scene_id for s in samples]), self.hands(samples)
        comparison, initial = self.supervision.comparison(samples, batch), self.method.initial(samples, batch)
        for start, made in (
            self.graphs.windows(batch, initial, steps, length)
            if hands is None and length == steps
            else windows(self.simulator, batch, initial, steps, length, hands=hands)
        ):
            states = States.of(made)
            if self._explodes(batch, states.positions, start, whole):
                return statistics
            losses, motion = comparison(states, start)
            momentum = unit * torch.stack([step.momentum for step in made])
            loss = weight * losses.sum()
            if objective.momentum_weight:
                loss = loss + objective.momentum_weight * weight * momentum.sum()
            self.accumulate(loss)
            statistics.images.append(losses.detach())
            statistics.momentum.append(momentum.detach())
            statistics.motion.append(motion)
        return statistics

    def _explodes(
        self, batch: SceneBatch | None, positions: Tensor | None, start: int, whole: list[SampleFacts]
    ) -> bool:
        """Whether a kernel of any rank moves too far from rest in the stretch after ``start`` predicted frames.

        All ranks call it, those without sequences with None, so that a rollout ends on all at once.

        Raises:
            DivergenceError: a position is not finite; names the step and the sequence.
        """
        own = [] if batch is None or positions is None else reach(batch, self.diagonals, positions).tolist()
        extent = [interleave(rows) for rows in zip(*filter(None, self.ranks.gather(own)), strict=True)]
        return check_reach(extent, start, whole) > self.objective.explosion

    def _static_loss(
        self, samples: list[SequenceSample], whole: list[SampleFacts], draws: torch.Generator
    ) -> Tensor | None:
        """Loss of one step from rest, in randomly drawn batches: a body at rest stays there, and its image is frame 0.

        One rank computes a scene's ||x_1 - X||^2 in diagonals; returns this rank's, detached, or None without one.
        """
        objective = self.objective
        if float(torch.rand((), generator=draws)) >= objective.static_chance(whole[0].steps):
            return None
        if objective.rest_image_weight and samples:
            batch = self.simulator.batch([s.scene_id for s in samples])
            comparison = self.images.comparison(samples, batch, slice(0, 1))
            losses, _ = comparison(States.of([self._step_from_rest(batch)]), 0)
            self.accumulate(objective.rest_image_weight / len(whole) * losses.sum())
        scene_ids = sorted({s.scene_id for s in whole})
        own = scene_ids[self.ranks.rank :: self.ranks.size]
        if not own:
            return None
        batch = self.simulator.batch(own)
        made = self._step_from_rest(batch)
        diagonal = torch.cat([batch.rest.new_full((len(batch.rest[m.kernels]), 1), self.diagonals[m.scene_id])
                              for m in batch.members])  # fmt: skip
        loss = static_loss(made.positions, batch.rest, diagonal) / len(scene_ids)
        self.accumulate(objective.static_weight * loss)
        return loss.detach()

    def _step_from_rest(self, batch: SceneBatch) -> Frame:
        """One step from rest, without surroundings: what falls does not stay."""
        prepared = self.simulator.prepare(batch, isolated=True)
        return self.simulator.step(batch, SimState(batch.rest, batch.rest), prepared=prepared)

    def _momentum_unit(self, samples: list[SequenceSample]) -> float:
        """Loss of the rest state on the frames of the batch, over all ranks: the unit of the momentum loss."""
        if self.objective.momentum_weight == 0:
            return 0.0
        scores = interleave(self.ranks.gather([self.rest_loss(sample) for sample in samples]))
        return sum(scores) / len(scores)

    def _stats(self, samples: list[SequenceSample], whole: list[SampleFacts], measured: Measured) -> dict[str, float]:
        """Joins and checks the figures of all ranks, and computes the logged metrics."""
        parts = self.ranks.gather((measured, [self.baseline(sample) for sample in samples]))
        joined = Measured.join([part[0] for part in parts])
        joined.check(whole)
        baselines = interleave([part[1] for part in parts])
        self.baselines.learn(whole, baselines)
        self.barren = 0 if joined.images else self.barren + 1
        if self.barren >= BARREN_BATCHES:
            far = f"kernels moved beyond {self.objective.explosion} diagonals in {BARREN_BATCHES} batches in a row"
            raise DivergenceError(describe(0, whole, None, far))
        return joined.stats(whole[0].steps, baselines)
