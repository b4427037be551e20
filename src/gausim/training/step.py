"""One optimiser step: inputs, rollout, loss terms, backward passes, update."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from gausim.core import ConfigError, DivergenceError
from gausim.data.dataset import SampleFacts, SequenceSample
from gausim.training.learner import Learner
from gausim.training.ranks.ranks import interleave
from gausim.training.rollout import Explosions, States, after, describe, windows
from gausim.training.statistics import Found, Statistics
from gausim.training.terms.term import StepInputs

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
        inputs = StepInputs(
            self.simulator, samples, whole, draws, statistics, self.ranks, self.accumulate, self.rest_loss,
            self.objective, self.images, self.diagonals,
        )  # fmt: skip
        for term in self.method.terms():
            term(inputs)
        weights = [p for p in self.parameters() if p.requires_grad]
        self.exchange.step(weights, self.network(), statistics)
        stats = self._read(samples, whole, statistics.fetch(self.settings.clip(optimizer)))
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
        """Predicts the batch with a backward pass after each stretch, so that memory does not grow with T."""
        steps, objective, ranks = whole[0].steps, self.objective, self.ranks
        if any(s.steps != steps for s in whole):
            raise ConfigError(f"a batch needs sequences of equal length, got {[s.steps for s in whole]} steps.")
        batch = self.simulator.batch([s.scene_id for s in samples]) if samples else None
        statistics, length = Statistics(), objective.window(steps)
        device = next(self.parameters()).device
        deferred = device if self.defers(device) else None
        explosions = Explosions(batch, self.diagonals, whole, objective.explosion, ranks=ranks, deferred=deferred)
        free, unit = self.free_motion.chosen(draws), self._momentum_unit(samples)
        if batch is None:  # takes part in the ranks' decision on where rollouts end
            any(explosions.end(None, start, statistics.reach) for start in range(0, steps, length))
            return statistics
        comparison = self.supervision.comparison(samples, batch)
        initial, kept = self.method.initial(samples, batch), objective.checkpoint_steps
        per = objective.step_weight(steps) / len(whole)
        own, last = torch.zeros(len(samples), device=device), initial
        hands = self.hands(samples)
        for start, made in (
            windows(self.simulator, batch, initial, steps, length, explosions.restart, checkpoint=kept, hands=hands)
            if kept or hands is not None or length < steps or self.measuring
            else self.graphs.windows(batch, explosions.restart(initial), steps, length)
        ):
            states = States.of(made)
            if explosions.end(states.positions, start, statistics.reach):
                break
            losses, motion = comparison(explosions.spared(states), start)
            statistics.motion.append(motion)
            momentum = explosions.counted(torch.stack([step.momentum for step in made]))
            self._descend(explosions.counted(losses), unit * momentum, per, statistics, measure=start == 0)
            own = own + per * explosions.counted(losses).detach().sum(0)
            last = after(made, last)
        else:
            if free is not None:
                state = self.isolated(batch, explosions.restart(last), hands, steps)
                statistics.growth = self.free_motion.descend(batch, state, own, len(whole), free, self.accumulate)
        return statistics

    def _descend(self, losses: Tensor, momentum: Tensor, per: float, statistics: Statistics, *, measure: bool) -> None:
        """Backward pass of one stretch, for the mean over sequences, independent of the stretch's length."""
        objective, network = self.objective, self.network()
        images_term = objective.image_weight * per * losses.sum()
        momentum_term = objective.momentum_weight * per * momentum.sum()
        weighted = momentum_term.requires_grad and objective.momentum_weight > 0
        if measure and weighted and network and self.measuring:
            statistics.pulls = _pull(images_term, network), _pull(momentum_term, network)
        self.accumulate(images_term + momentum_term if weighted else images_term)
        statistics.images.append(losses.detach())
        statistics.momentum.append(momentum.detach())

    def _momentum_unit(self, samples: list[SequenceSample]) -> float:
        """Loss of the rest state on the frames of the batch, over all ranks: the unit of the momentum loss."""
        if self.objective.momentum_weight == 0:
            return 0.0
        scores = interleave(self.ranks.gather([self.rest_loss(sample) for sample in samples]))
        return sum(scores) / len(scores)

    def _read(self, samples: list[SequenceSample], whole: list[SampleFacts], found: Found) -> dict[str, float]:
        """Joins and checks the values of all ranks, and computes the logged metrics."""
        parts = self.ranks.gather((found, [self.baseline(sample) for sample in samples]))
        lasting = Found.join([part[0] for part in parts]).lasting(whole, self.objective.explosion)
        baselines = interleave([part[1] for part in parts])
        self.baselines.learn(whole, baselines)
        self.barren = 0 if lasting.images else self.barren + 1
        if self.barren >= BARREN_BATCHES:
            far = f"kernels moved beyond {self.objective.explosion} diagonals in {BARREN_BATCHES} batches in a row"
            raise DivergenceError(describe(0, whole, None, far))
        return lasting.stats(whole[0].steps, baselines)


def _pull(loss: Tensor, network: list[nn.Parameter]) -> Tensor:
    """Gradient of one loss term with respect to the network."""
    grads = torch.autograd.grad(loss, network, retain_graph=True, allow_unused=True, materialize_grads=True)
    return torch.cat([grad.flatten() for grad in grads])
