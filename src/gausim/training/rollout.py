"""Rollout of a batch in stretches; loss gradients flow within a stretch only."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as torch_checkpoint

from gausim.core import DivergenceError, Frame, Hands, SimState
from gausim.data.dataset import SampleFacts
from gausim.models.reference.reference import hand_motion
from gausim.nn.normaliser import gathering_nothing, normalisers_of
from gausim.training.contracts import SceneBatch, Simulator
from gausim.training.ranks.ranks import Ranks, interleave


def checkpointed_step(
    model: Simulator, batch: SceneBatch, state: SimState, moved: Mapping[str, Any] = MappingProxyType({})
) -> Frame:
    """A step whose graph keeps the input only (gradient checkpointing): it is recomputed in the backward pass.

    It uses nothing prepared for other steps, so that the second computation equals the first; the running statistics
    of the inputs do not count it twice. ``moved`` may hold the hands of the step.
    """
    normalisers, calls = normalisers_of(cast(nn.Module, model)), itertools.count()

    def run(positions: Tensor, previous: Tensor) -> tuple[Tensor, ...]:
        with gathering_nothing(normalisers) if next(calls) else nullcontext():
            step = model.step(batch, SimState(positions, previous), **moved)
        last = positions if step.state is None else step.state.previous
        return step.positions, step.deformation_gradients, step.rotations, step.momentum, last

    # A step draws no random numbers, so no generator needs to be restored.
    made = torch_checkpoint(run, state.positions, state.previous, use_reentrant=False, preserve_rng_state=False)
    positions, deformation_gradients, rotations, momentum, last = made
    return Frame(positions, deformation_gradients, rotations, SimState(positions, last), momentum)


class States(NamedTuple):
    """T predicted frames of all members of a batch (see :class:`gausim.core.Frame`)."""

    positions: Float[Tensor, "T K 3"]
    deformation_gradients: Float[Tensor, "T N 3 3"]
    rotations: Float[Tensor, "T N 3 3"]

    @staticmethod
    def of(steps: Sequence[Frame]) -> States:
        """Stacks the steps of a stretch."""
        return States(*(torch.stack([getattr(step, name) for step in steps]) for name in States._fields))


def windows(
    model: Simulator,
    batch: SceneBatch,
    initial: SimState,
    steps: int,
    length: int,
    restart: Callable[[SimState], SimState] | None = None,
    *,
    checkpoint: bool = False,
    hands: Sequence[Hands | None] | None = None,
    isolated: bool = False,
) -> Iterator[tuple[int, list[Frame]]]:
    """Predicts ``steps`` frames of a batch in stretches of ``length`` frames.

    Loss gradients flow within a stretch and, from the first one, into the initial state; each stretch starts from
    detached values, so a backward pass after every stretch needs memory for one stretch only. ``restart`` is applied to
    the first state of each stretch; ``checkpoint`` recomputes each step in the backward pass. ``hands`` are those of
    every member; ``isolated`` leaves out the surroundings (:meth:`gausim.models.step.simulator.GausSim.prepare`).

    Yields:
        The number of frames predicted before the stretch, and its steps.
    """
    state = initial
    for start in range(0, steps, length):
        state = state.detach() if start else state
        state = state if restart is None else restart(state)
        made: list[Frame] = []
        prepared = None if checkpoint else model.prepare(batch, **({"isolated": True} if isolated else {}))
        for number in range(start, start + min(length, steps - start)):
            moved: dict[str, Any] = {}
            if hands is not None:
                moved["hands"] = [hand_motion(own, number) for own in hands]
            made.append(
                checkpointed_step(model, batch, state, moved)
                if checkpoint
                else model.step(batch, state, prepared=prepared, **moved)
            )
            state = made[-1].following(state)
        yield start, made


def after(steps: Sequence[Frame], state: SimState) -> SimState:
    """The state after a stretch that began at ``state``, detached."""
    for step in steps:
        state = step.following(state)
    return state.detach()


def reach(batch: SceneBatch, diagonals: Sequence[float], positions: Float[Tensor, "T K 3"]) -> Float[Tensor, "T S"]:
    """Largest distance of a kernel from its rest position, per step and member [diagonals of the member's scene].

    Of a body that moves as a whole, the rest position moves along with its centre.
    """
    with torch.no_grad():
        columns = []
        for m in batch.members:
            moved = positions[:, m.kernels] - batch.rest[m.kernels]
            moved = moved - moved.mean(1, keepdim=True) if getattr(m, "free", False) else moved
            columns.append(moved.norm(dim=-1).amax(1) / diagonals[m.scene_id])
        return torch.stack(columns, 1)


def check_reach(table: Sequence[Sequence[float]], start: int, samples: Sequence[SampleFacts]) -> float:
    """The largest value that :func:`reach` returned for a stretch.

    Raises:
        DivergenceError: a position is not finite; names the step and the sequence.
    """
    for t, row in enumerate(table):
        for value, sample in zip(row, samples, strict=True):
            if not value < float("inf"):
                raise DivergenceError(describe(start + t, samples, sample, f"positions are {value}"))
    return max(map(max, table))


class Explosions:
    """Ends a rollout before the stretch in which a kernel moves too far from rest; that stretch has no loss.

    It ends on all ranks at once, as it would on one rank with all sequences. Where reading a value does not block the
    host, the loop stops. Otherwise (``deferred``) it continues from the rest state with zero loss, and the length of
    the rollout is read at the end of the step.
    """

    def __init__(
        self,
        batch: SceneBatch | None,
        diagonals: Sequence[float],
        samples: Sequence[SampleFacts],
        limit: float,
        *,
        deferred: torch.device | None,
        ranks: Ranks,
    ) -> None:
        """Begins a rollout of the samples of all ranks.

        ``batch`` is this rank's part, None without sequences; ``limit`` is the largest distance from rest [diagonals
        of the member's scene]; ``deferred`` is the device where reads are deferred, else None.
        """
        self._batch, self._diagonals, self._samples = batch, diagonals, samples
        self._limit, self._ranks = limit, ranks
        self._lasts = None if deferred is None else torch.ones((), dtype=torch.bool, device=deferred)

    def end(self, positions: Float[Tensor, "T K 3"] | None, start: int, found: list[Tensor]) -> bool:
        """Checks a stretch; returns whether to stop, else appends its reach to ``found``.

        A rank without sequences has no positions and receives the result of the others.

        Raises:
            DivergenceError: a position is not finite (not when deferred).
        """
        extent = None
        if self._batch is not None and positions is not None:
            extent = reach(self._batch, self._diagonals, positions)
        if self._lasts is not None:
            calm = self._lasts if extent is None else self._lasts & (extent.amax() <= self._limit)
            self._lasts = self._ranks.everywhere(calm)
        else:
            tables = self._ranks.gather([] if extent is None else extent.tolist())
            whole = [interleave(rows) for rows in zip(*filter(None, tables), strict=True)]
            if check_reach(whole, start, self._samples) > self._limit:
                return True
        if extent is not None:
            found.append(extent)
        return False

    def spared(self, states: States) -> States:
        """The states, or the rest state once the rollout has ended, which can always be rendered."""
        if self._lasts is None or self._batch is None:
            return states
        identity = torch.eye(3, dtype=states.deformation_gradients.dtype, device=states.deformation_gradients.device)
        rests = (self._batch.rest, identity, identity)
        return States(*(torch.where(self._lasts, x, r) for x, r in zip(states, rests, strict=True)))

    def counted(self, values: Tensor) -> Tensor:
        """The values, or zeros once the rollout has ended."""
        return values if self._lasts is None else torch.where(self._lasts, values, torch.zeros_like(values))

    def restart(self, state: SimState) -> SimState:
        """The state, or the rest state once the rollout has ended."""
        if self._lasts is None or self._batch is None:
            return state
        return SimState(*(torch.where(self._lasts, x, self._batch.rest) for x in (state.positions, state.previous)))


def describe(step: int | None, samples: Sequence[SampleFacts], sample: SampleFacts | None, what: str) -> str:
    """The message of a divergence: the step, the sequence and the value that is not finite."""
    name = f"{sample.object_name}/{sample.sequence_name}" if sample is not None else ", ".join(
        f"{s.object_name}/{s.sequence_name}" for s in samples
    )  # fmt: skip
    where = f"predicted step {step + 1} of {samples[0].steps}, " if step is not None else ""
    return (
        f"training diverged at {where}sequence {name}: {what}. Lower optimizer.network_lr or optimizer.initial_lr, or "
        "let the curriculum grow more slowly; the last checkpoint is from before this step."
    )
