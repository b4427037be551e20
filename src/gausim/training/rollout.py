"""Rollout of a batch in stretches; loss gradients flow within a stretch only."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import DivergenceError, Frame, Hands, SimState
from gausim.data.dataset import SampleFacts
from gausim.models.reference.reference import hand_motion
from gausim.training.contracts import SceneBatch, Simulator


class States(NamedTuple):
    """T predicted frames of all members of a batch (see :class:`gausim.core.Frame`)."""

    positions: Float[Tensor, "T K 3"]
    deformation_gradients: Float[Tensor, "T N 3 3"]
    rotations: Float[Tensor, "T N 3 3"]

    @staticmethod
    def of(steps: Sequence[Any]) -> "States":
        """Stacks the steps of a stretch, which have its fields."""
        return States(*(torch.stack([getattr(step, name) for step in steps]) for name in States._fields))


def windows(
    model: Simulator,
    batch: SceneBatch,
    initial: SimState,
    steps: int,
    length: int,
    *,
    hands: Sequence[Hands | None] | None = None,
) -> Iterator[tuple[int, list[Frame]]]:
    """Predicts ``steps`` frames of a batch in stretches of ``length`` frames.

    Loss gradients flow within a stretch and, from the first one, into the initial state; each stretch starts from
    detached values, so a backward pass after every stretch needs memory for one stretch only. ``hands`` are those of
    every member.

    Yields:
        The number of frames predicted before the stretch, and its steps.
    """
    state = initial
    for start in range(0, steps, length):
        state = state.detach() if start else state
        made: list[Frame] = []
        prepared = model.prepare(batch)
        for number in range(start, start + min(length, steps - start)):
            moved: dict[str, Any] = {}
            if hands is not None:
                moved["hands"] = [hand_motion(own, number) for own in hands]
            made.append(model.step(batch, state, prepared=prepared, **moved))
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


def describe(step: int | None, samples: Sequence[SampleFacts], sample: SampleFacts | None, what: str) -> str:
    """The message of a divergence: the step, the sequence and the value that is not finite."""
    name = f"{sample.object_name}/{sample.sequence_name}" if sample is not None else ", ".join(
        f"{s.object_name}/{s.sequence_name}" for s in samples
    )  # fmt: skip
    where = f"predicted step {step + 1} of {samples[0].steps}, " if step is not None else ""
    return (
        f"training diverged at {where}sequence {name}: {what}. Lower optimizer.network_lr or optimizer.initial_lr, or "
        "let T grow more slowly; the last checkpoint is from before this step."
    )
