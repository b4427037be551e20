"""The second stage of a training: the network learns single steps between tracked frames, then short rollouts on them.

Where loss gradients stop after every step of a rollout, the target of a state that the model made itself is a true
frame: it learns a map from its own states onto the films, which predicts nothing where the films end. Where the state
is a true one, too, it learns the flow itself,

    min  sum_t |step(x_t + e, x_{t-1} + e + d) - x_{t+1}|^2

over pairs of tracked frames in random order. The noise e, d of every unit stands for the errors of a rollout. Rollouts
of T frames on the tracks follow, T growing, half of them from frame 0, through which loss gradients flow as a whole.

Motions of a few frames say little of smaller ones: a network that they alone have taught need not come to rest. Small
motions of an elastic body add up, so a part of the lessons is on sums of two displacements from rest, a u_i + b u_j, of
the same body, with (a, b) anywhere in the unit disc.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter

from gausim.core import SimState
from gausim.data.sampler import hash_seed
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.step.simulator import GausSim
from gausim.models.template.template import RestTemplate
from gausim.nn.normaliser import gathering_nothing, normalisers_of
from gausim.nn.schedules import CosineSchedule
from gausim.runs.bar import with_bar
from gausim.training.learner import Learner
from gausim.training.optimizers import set_rates
from gausim.training.plan import Teaching
from gausim.training.rollout import States, windows
from gausim.training.tracking import Track

# Pairs of frames, or rollouts, in one update; fewer where there are fewer sequences.
TOGETHER = 8
# Updates over which the rates rise, and fraction of the rollouts over which T grows from SHORTEST to its largest.
WARMUP, GROWING, SHORTEST = 10.0, 0.5, 2
# Separates the random numbers from others of the same seed, and weight of the past in the figures that are told.
TEACHING, PAST = 3, 0.95

# Sequence (its place among the tracks) and frame at which a rollout begins.
Start = tuple[int, int]


class Lesson:
    """Rollouts from tracked states, compared with the tracks."""

    def __init__(
        self, learner: Learner, model: GausSim, tracks: Sequence[Track], settings: Teaching, seed: int
    ) -> None:
        self._learner, self._model, self._settings = learner, model, settings
        self._scenes = [known.scene_id for known in tracks]
        self._numbers = [known.sequence_id for known in tracks]
        self._positions = [model.scenes[known.scene_id].means.to(known.moved) + known.moved for known in tracks]
        self.last = min(len(positions) for positions in self._positions) - 1
        self.draws = torch.Generator().manual_seed(hash_seed(seed, TEACHING))

    def pairs(self) -> Iterator[list[Start]]:
        """All tracked frames but the last, once, in random order."""
        every = [(i, t) for i in range(len(self._positions)) for t in range(self.last)]
        order = torch.randperm(len(every), generator=self.draws).tolist()
        size = min(TOGETHER, len(self._positions))
        for first in range(0, len(order), size):
            yield [every[number] for number in order[first : first + size]]

    def rolls(self, steps: int) -> Iterator[list[Start]]:
        """All sequences once, in random order; about half of them start at frame 0, the others anywhere."""
        order = torch.randperm(len(self._positions), generator=self.draws).tolist()
        begins = torch.randint(self.last - steps + 1, (len(order),), generator=self.draws)
        begins = torch.where(torch.rand(len(order), generator=self.draws) < 0.5, 0, begins)
        starts, size = list(zip(order, begins.tolist(), strict=True)), min(TOGETHER, len(order))
        for first in range(0, len(order), size):
            yield starts[first : first + size]

    def state(self, batch: SceneBatch, starts: Sequence[Start], *, trained: bool = False) -> SimState:
        """Tracked positions and those before; before frame 0 they go on from the initial state of the sequence."""
        found = [self._own(i, t, trained=trained) for i, t in starts]
        return SimState(
            torch.cat([own.positions for own in found]).to(batch.rest),
            torch.cat([own.previous for own in found]).to(batch.rest),
            tuple(torch.cat(x).to(batch.rest) for x in zip(*(own.older for own in found), strict=True)),
        )

    def _own(self, place: int, frame: int, *, trained: bool) -> SimState:
        """The state of one sequence at a frame."""
        positions, first = self._positions[place], self._learner.method.state(self._numbers[place]).previous
        known = [positions[t] for t in range(frame, -1, -1)][: 2 + self._model.history]
        if len(known) < 2 + self._model.history:
            known.append(first if trained else first.detach())
        return SimState(known[0], known[1], tuple(known[2:])).remembering(self._model.history)

    def errors(
        self, starts: Sequence[Start], steps: int, *, noisy: bool = False, trained: bool = False, summed: bool = False
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Mean squared distance of rollouts from the tracks, and that of their beginnings [% of the diagonal]^2."""
        batch = self._model.batch([self._scenes[i] for i, _ in starts])
        state, true = self._motion(batch, starts, steps, trained=trained)
        if summed:
            state, true = self._sums(batch, starts, steps, state, true, trained=trained)
        if noisy:
            noise = self._settings.noise
            shift, change = self._drawn(batch, noise), self._drawn(batch, noise / 2)
            older = tuple(x + shift for x in state.older)
            state = SimState(state.positions + shift, state.previous + shift + change, older)
        ((_, made),) = windows(self._learner.simulator, cast(Any, batch), state, steps, steps)
        positions, weight = States.of(made).positions, _weights(batch)
        wrong, moved = positions - true[1:], true[1:] - (true[:1] if steps == 1 else batch.rest)
        return (weight * wrong.square()).sum() / steps, (weight * moved.square()).sum() / steps

    def _motion(
        self, batch: SceneBatch, starts: Sequence[Start], steps: int, *, trained: bool
    ) -> tuple[SimState, Float[Tensor, "F K 3"]]:
        """Tracked states, and the positions from there on."""
        true = torch.cat([self._positions[i][t : t + steps + 1] for i, t in starts], 1)
        return self.state(batch, starts, trained=trained), true.to(batch.rest)

    def _sums(
        self, batch: SceneBatch, starts: Sequence[Start], steps: int, state: SimState, true: Tensor, *, trained: bool
    ) -> tuple[SimState, Float[Tensor, "F K 3"]]:
        """Some of the motions replaced by sums with others of the same body, all others as they are."""
        own = [[j for j, scene in enumerate(self._scenes) if scene == self._scenes[i]] for i, _ in starts]
        draws = torch.rand(5, len(starts), generator=self.draws)
        places = [(numbers[int(x * len(numbers))], int(y * (self.last - steps + 1))) for numbers, x, y in
                  zip(own, draws[0].tolist(), draws[1].tolist(), strict=True)]  # fmt: skip
        other, also = self._motion(batch, places, steps, trained=trained)
        size, angle, chosen = draws[2].sqrt(), 2 * math.pi * draws[3], draws[4] < self._settings.sums
        factors = torch.stack((torch.where(chosen, size * angle.cos(), 1.0), chosen * size * angle.sin()))
        counts = torch.tensor([member.kernels.stop - member.kernels.start for member in batch.members])
        a, b = factors.repeat_interleave(counts, 1)[:, :, None].to(batch.rest)

        def add(x: Tensor, y: Tensor) -> Tensor:
            return batch.rest + a * (x - batch.rest) + b * (y - batch.rest)

        older = tuple(add(x, y) for x, y in zip(state.older, other.older, strict=True))
        begun = SimState(add(state.positions, other.positions), add(state.previous, other.previous), older)
        return begun, add(true, also)

    def _drawn(self, batch: SceneBatch, size: float) -> Float[Tensor, "K 3"]:
        """Noise of every unit, in its kernels; none where a kernel is pinned."""
        level, unit = batch.levels[-1], batch.inherited
        drawn = torch.randn(level.count, 3, generator=self.draws).to(batch.rest) * (size * level.length)
        return torch.where((unit < 0)[:, None], 0.0, drawn.index_select(0, unit.clamp_min(0)))


def _weights(batch: SceneBatch) -> Float[Tensor, "K 1"]:
    """Weight of every kernel: of every member alike, and none of what never moves."""
    free, length = (batch.inherited >= 0).to(batch.rest), batch.levels[-1].length[:, 0]
    for member in batch.members:
        free[member.kernels] /= free[member.kernels].sum() * len(batch.members)
    return (free * (100 / length.index_select(0, batch.inherited.clamp_min(0))).square())[:, None]


def teach(learner: Learner, model: GausSim, tracks: Sequence[Track], settings: Teaching, *, seed: int, quiet: bool,
          fitted: bool) -> None:  # fmt: skip
    """Trains on single steps between tracked frames, then on rollouts on the tracks.

    Args:
        learner: the method; its optimiser's settings apply.
        model: its simulator.
        tracks: from :func:`gausim.training.tracking.track`.
        settings: length, sums and noise.
        seed: of the order and the noise.
        quiet: show no progress bar.
        fitted: whether densities, attributes and template are fitted; single steps then train the network alone.
    """
    lesson, normalisers = Lesson(learner, model, tracks, settings, seed), normalisers_of(model)
    if isinstance(model.template, RestTemplate):
        for scene_id in range(len(model.scenes)):
            own = [track.moved for track in tracks if track.scene_id == scene_id]
            model.template.oscillator(scene_id).copy_(torch.tensor(oscillator_of(own)))
    model.train()
    with torch.no_grad():
        for starts in lesson.pairs():
            lesson.errors(starts, 1)
    for normaliser in normalisers:
        normaliser.absorb()
    groups = learner.groups()
    first = {name: own for name, own in groups.items() if name == "network" or (name == "scene" and not fitted)}
    with torch.enable_grad(), gathering_nothing(normalisers):
        if settings.shows:
            left = descend(learner, lesson, first, _pairs(lesson, settings), 1.0, "Teaching single steps", quiet)
            print(f"  teach: of the motion between two frames, single steps leave {left:.3f}", flush=True)
        if settings.rolls:
            rate = settings.roll_factor
            left = descend(learner, lesson, groups, _rolls(lesson, settings), rate, "Teaching rollouts", quiet)
            print(f"  roll: rollouts on the tracks leave {left:.3f} of the motion", flush=True)


def oscillator_of(motions: Sequence[Float[Tensor, "F K 3"]]) -> tuple[float, float]:
    """Angular frequency [1 / frame] of an oscillator like the motions, and the part of its energy lost in a frame.

    The frequency is the ratio of velocities and displacements. The loss is the slope of the logarithm of a motion's
    energy: the mean over motions, weighted by their energies, less two standard errors of it; 0 of a single motion.
    """
    speeds = [u.diff(dim=0).square().sum((1, 2)).double() for u in motions]
    places = [((u[1:] + u[:-1]) / 2).square().sum((1, 2)).double() for u in motions]
    square = sum(float(speed.sum()) for speed in speeds) / max(sum(float(place.sum()) for place in places), 1e-30)
    if len(motions) < 2:
        return math.sqrt(square), 0.0
    energies = [(speed + square * place).clamp_min(1e-30) for speed, place in zip(speeds, places, strict=True)]
    slopes = torch.stack([_slope(energy.log()) for energy in energies])
    weights = torch.stack([energy.sum() for energy in energies])
    weights = weights / weights.sum()
    mean = weights @ slopes
    deviation = ((weights * (slopes - mean)).square().sum() * len(slopes) / (len(slopes) - 1)).sqrt()
    return math.sqrt(square), 1 - math.exp(float(mean + 2 * deviation))


def _slope(values: Float[Tensor, " F"]) -> Float[Tensor, ""]:
    """Slope of a line through values at 0, 1, ...; of one value 0."""
    time = torch.arange(len(values)).to(values) - (len(values) - 1) / 2
    return time @ values / (time @ time).clamp_min(1e-30)


# (done, total) updates, the rollouts' beginnings and their number of frames
Update = tuple[float, list[Start], int]


def _pairs(lesson: Lesson, settings: Teaching) -> list[Update]:
    shows = [list(lesson.pairs()) for _ in range(settings.shows)]
    every = [starts for show in shows for starts in show]
    return [(number / len(every), starts, 1) for number, starts in enumerate(every)]


def _rolls(lesson: Lesson, settings: Teaching) -> list[Update]:
    found: list[Update] = []
    for show in range(settings.rolls):
        part = show / settings.rolls
        steps = min(lesson.last, SHORTEST + int((lesson.last - SHORTEST + 1) * part / GROWING))
        batches = list(lesson.rolls(steps))
        found += [(part + n / len(batches) / settings.rolls, starts, steps) for n, starts in enumerate(batches)]
    return found


def descend(
    learner: Learner,
    lesson: Lesson,
    groups: dict[str, list[Parameter]],
    updates: Sequence[Update],
    rate: float,
    text: str,
    quiet: bool,
) -> float:
    """One update after another; returns what is left of the motion in the last ones."""
    settings, falling = learner.settings, CosineSchedule(warmup=0.0)
    optimizer = settings.build({name: [p for p in own if p.requires_grad] for name, own in groups.items()})
    wrong = moved = 0.0
    for number, (done, starts, steps) in enumerate(with_bar(updates, text, quiet=quiet)):
        factor = rate * falling.factor(done, 1.0) * min(1.0, (number + 1) / WARMUP)
        set_rates(optimizer, lambda name, factor=factor: factor)  # type: ignore[misc]
        optimizer.zero_grad(set_to_none=True)
        loss, motion = lesson.errors(starts, steps, noisy=steps == 1, trained=steps > 1, summed=True)
        if not bool(torch.isfinite(loss)):
            continue
        loss.backward()
        settings.clip(optimizer)
        optimizer.step()
        wrong, moved = (PAST * old + (1 - PAST) * float(new.detach()) for old, new in ((wrong, loss), (moved, motion)))
    optimizer.zero_grad(set_to_none=True)
    return math.sqrt(wrong / max(moved, 1e-30))
