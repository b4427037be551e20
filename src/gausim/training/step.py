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


def optimise(
    learner: Learner,
    samples: list[SequenceSample],
    optimizer: Optimizer,
    draws: torch.Generator,
    advance: Callable[[], object],
) -> dict[str, float]:
    """One optimiser step with all losses; returns its logged metrics.

    ``samples`` are this rank's part of the batch, which may be empty with several ranks; ``draws`` generates the random
    numbers of the step, and ``advance`` calls the optimiser.

    Raises:
        DivergenceError: a value is not finite; the parameters are unchanged.
    """
    optimizer.zero_grad(set_to_none=True)
    whole = interleave(learner.ranks.gather([sample.facts for sample in samples]))
    learner.exchange.begin(lambda: _see_first_frame(learner, samples))
    statistics = roll_out(learner, samples, whole, draws)
    inputs = StepInputs(
        samples, whole, draws, statistics, learner.ranks, learner.accumulate, learner.rest_loss, learner.objective,
        learner.images, learner.diagonals,
    )  # fmt: skip
    for term in learner.method.terms():
        term.descend(inputs)
    weights = [p for p in learner.parameters() if p.requires_grad]
    learner.exchange.step(weights, learner.network(), statistics)
    stats = _read(learner, samples, whole, statistics.fetch(learner.settings.clip(optimizer)))
    learner.exchange.absorb()
    advance()
    learner.average.update(learner.named_parameters())
    learner.shown = len(whole)
    return stats


@torch.no_grad()
def _see_first_frame(learner: Learner, samples: list[SequenceSample]) -> None:
    """Initialises the input statistics of a new model with the first frame of its first batch."""
    if samples:
        batch, hands = learner.simulator.batch([s.scene_id for s in samples]), learner.hands(samples)
        for _ in windows(learner.simulator, batch, learner.initial(samples, batch), 1, 1, hands=hands):
            pass


def roll_out(
    learner: Learner, samples: list[SequenceSample], whole: list[SampleFacts], draws: torch.Generator
) -> Statistics:
    """Predicts the batch with a backward pass after each stretch, so that memory does not grow with T."""
    steps, objective, ranks = whole[0].steps, learner.objective, learner.ranks
    if any(s.steps != steps for s in whole):
        raise ConfigError(f"a batch needs sequences of equal length, got {[s.steps for s in whole]} steps.")
    batch = learner.simulator.batch([s.scene_id for s in samples]) if samples else None
    statistics, length = Statistics(), objective.window(steps)
    device = next(learner.parameters()).device
    deferred = device if learner.defers(device) else None
    explosions = Explosions(batch, learner.diagonals, whole, objective.explosion, ranks=ranks, deferred=deferred)
    free, unit = learner.free_motion.chosen(draws), _momentum_unit(learner, samples)
    if batch is None:  # takes part in the ranks' decision on where rollouts end
        any(explosions.end(None, start, statistics.reach) for start in range(0, steps, length))
        return statistics
    comparison = learner.supervision.comparison(samples, batch)
    initial, kept = learner.initial(samples, batch), objective.checkpoint_steps
    per = objective.step_weight(steps) / len(whole)
    own, last = torch.zeros(len(samples), device=device), initial
    hands = learner.hands(samples)
    for start, made in (
        windows(learner.simulator, batch, initial, steps, length, explosions.restart, checkpoint=kept, hands=hands)
        if kept or hands is not None or length < steps or learner.measuring
        else learner.graphs.windows(batch, explosions.restart(initial), steps, length)
    ):
        states = States.of(made)
        if explosions.end(states.positions, start, statistics.reach):
            break
        losses, motion = comparison(explosions.spared(states), start)
        statistics.motion.append(motion)
        momentum = explosions.counted(torch.stack([step.momentum for step in made]))
        descend(learner, explosions.counted(losses), unit * momentum, per, statistics, measure=start == 0)
        own = own + per * explosions.counted(losses).detach().sum(0)
        last = after(made, last)
    else:
        if free is not None:
            state = learner.isolated(batch, explosions.restart(last), hands, steps)
            statistics.growth = learner.free_motion.descend(batch, state, own, len(whole), free, learner.accumulate)
    return statistics


def descend(
    learner: Learner, losses: Tensor, momentum: Tensor, per: float, statistics: Statistics, *, measure: bool
) -> None:
    """Backward pass of one stretch, for the mean over sequences, independent of the stretch's length."""
    objective, network = learner.objective, learner.network()
    images_term = objective.image_weight * per * losses.sum()
    momentum_term = objective.momentum_weight * per * momentum.sum()
    weighted = momentum_term.requires_grad and objective.momentum_weight > 0
    if measure and weighted and network and learner.measuring:
        statistics.pulls = _pull(images_term, network), _pull(momentum_term, network)
    learner.accumulate(images_term + momentum_term if weighted else images_term)
    statistics.images.append(losses.detach())
    statistics.momentum.append(momentum.detach())


def _pull(loss: Tensor, network: list[nn.Parameter]) -> Tensor:
    """Gradient of one loss term with respect to the network."""
    grads = torch.autograd.grad(loss, network, retain_graph=True, allow_unused=True, materialize_grads=True)
    return torch.cat([grad.flatten() for grad in grads])


def _momentum_unit(learner: Learner, samples: list[SequenceSample]) -> float:
    """Loss of the rest state on the frames of the batch, over all ranks: the unit of the momentum loss."""
    if learner.objective.momentum_weight == 0:
        return 0.0
    scores = interleave(learner.ranks.gather([learner.rest_loss(sample) for sample in samples]))
    return sum(scores) / len(scores)


def _read(learner: Learner, samples: list[SequenceSample], whole: list[SampleFacts], found: Found) -> dict[str, float]:
    """Joins and checks the values of all ranks, and computes the logged metrics."""
    parts = learner.ranks.gather((found, [learner.baseline(sample) for sample in samples]))
    lasting = Found.join([part[0] for part in parts]).lasting(whole, learner.objective.explosion)
    baselines = interleave([part[1] for part in parts])
    learner.baselines.learn(whole, baselines)
    learner.barren = 0 if lasting.images else learner.barren + 1
    if learner.barren >= BARREN_BATCHES:
        far = f"kernels moved beyond {learner.objective.explosion} diagonals in {BARREN_BATCHES} batches in a row"
        raise DivergenceError(describe(0, whole, None, far))
    return lasting.stats(whole[0].steps, baselines)
