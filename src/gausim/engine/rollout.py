"""Rolling a batch forward in stretches that gradients do not leave, and drawing what was predicted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras, DivergenceError, GaussianScene, Renderer, SimState
from gausim.data.dataset import SequenceSample
from gausim.engine.contracts import SceneBatch, Simulator
from gausim.engine.contracts import Step as PredictedStep
from gausim.render.draw import SceneAppearance, draw


@dataclass(frozen=True, eq=False)
class ViewGroup:
    """Sequences of a batch that one call of the renderer can draw together.

    Attributes:
        scene_id: their scene.
        members: their places in the batch.
        cameras: what looks at all of them.
    """

    scene_id: int
    members: tuple[int, ...]
    cameras: Cameras


def view_key(scene_id: int, cameras: Cameras) -> tuple[int, bytes, bytes, int, int]:
    """What must agree for two sequences to be drawn in one call."""
    numbers = [x.detach().cpu().numpy().tobytes() for x in (cameras.viewmats, cameras.Ks)]
    return (scene_id, numbers[0], numbers[1], cameras.width, cameras.height)


def group_views(samples: Sequence[SequenceSample]) -> list[ViewGroup]:
    """Sorts the sequences of a batch by scene and cameras."""
    places: dict[Any, list[int]] = {}
    for i, sample in enumerate(samples):
        places.setdefault(view_key(sample.scene_id, sample.cameras), []).append(i)
    return [ViewGroup(samples[p[0]].scene_id, tuple(p), samples[p[0]].cameras) for p in places.values()]


class Looks:
    """The appearance of every scene's foreground, made once and moved to the device on first use."""

    def __init__(self, scenes: Sequence[GaussianScene]) -> None:
        """Keeps the scenes."""
        self._scenes = list(scenes)
        self._made: dict[int, SceneAppearance] = {}

    def of(self, scene_id: int, like: Tensor) -> SceneAppearance:
        """The appearance of a scene, on the device and in the type of ``like``."""
        if scene_id not in self._made:
            scene = self._scenes[scene_id]
            self._made[scene_id] = SceneAppearance.of(scene, scene.foreground)
        self._made[scene_id] = self._made[scene_id].to(like)
        return self._made[scene_id]


def windows(
    model: Simulator,
    batch: SceneBatch,
    initial: SimState,
    steps: int,
    length: int,
    perturb: Callable[[SimState], SimState] | None = None,
) -> Iterator[tuple[int, list[PredictedStep]]]:
    """Rolls a batch ``steps`` frames forward, ``length`` at a time.

    Gradients flow within a stretch and, from the first one, into the initial state; each stretch starts from detached
    numbers, so a caller that calls backward after every stretch needs memory for one only.

    Args:
        model: predicts.
        batch: the disjoint graph.
        initial: x_0 and x_{-1} of all members.
        steps: predicted frames.
        length: of a stretch.
        perturb: applied to the state that each stretch starts from.

    Yields:
        The number of frames predicted before the stretch, and its steps.
    """
    state = initial
    for start in range(0, steps, length):
        state = state.detach() if start else state
        state = perturb(state) if perturb is not None else state
        made = []
        for _ in range(min(length, steps - start)):
            step = model.step(batch, state)
            state = SimState(step.positions, state.positions)
            made.append(step)
        yield start, made


def draw_steps(
    renderer: Renderer, look: SceneAppearance, group: ViewGroup, batch: SceneBatch, steps: Sequence[PredictedStep]
) -> Float[Tensor, "T S V H W 3"]:
    """Images of T predicted frames of the S sequences of a group."""
    members = [batch.members[i] for i in group.members]
    positions = torch.stack([step.positions[m.kernels] for step in steps for m in members])
    gradients = torch.stack([step.gradients[m.units] for step in steps for m in members])
    rotations = torch.stack([step.rotations[m.units] for step in steps for m in members])
    units = members[0].unit_of_kernel
    images = draw(renderer, look, positions, gradients, rotations, units, group.cameras).rgb
    return images.reshape(len(steps), len(members), *images.shape[1:])


def draw_rest(
    renderer: Renderer, look: SceneAppearance, rest: Float[Tensor, "K 3"], cameras: Cameras
) -> Float[Tensor, "V H W 3"]:
    """Images of the rest state: the static prediction."""
    identity = torch.eye(3, dtype=rest.dtype, device=rest.device)[None, None]
    units = torch.zeros(rest.shape[0], dtype=torch.long, device=rest.device)
    with torch.no_grad():
        return draw(renderer, look, rest[None], identity, identity, units, cameras).rgb[0]


class UnitNoise:
    """Moves the units of a batch at random, as the errors of a longer rollout would.

    Kernels of a unit move together: independent noise would average out in every barycentre that the network sees.
    """

    def __init__(
        self, batch: SceneBatch, scenes: Sequence[GaussianScene], deviation: Sequence[float], generator: torch.Generator
    ) -> None:
        """``deviation`` is one standard deviation per scene [scene units]."""
        self._batch, self._generator = batch, generator
        self._scales = []
        for member in batch.members:
            scene = scenes[member.scene_id]
            moves = (scene.simulated & ~scene.pinned).to(batch.rest)
            self._scales.append(moves[:, None] * deviation[member.scene_id])

    def __call__(self, state: SimState) -> SimState:
        """The state with its latest positions moved."""
        parts = []
        for member, scale in zip(self._batch.members, self._scales, strict=True):
            count = member.units.stop - member.units.start
            noise = torch.randn(count, 3, generator=self._generator).to(scale)
            parts.append(noise[member.unit_of_kernel] * scale)
        return SimState(state.positions + torch.cat(parts), state.previous)


def furthest(
    batch: SceneBatch,
    diagonals: Sequence[float],
    steps: Sequence[PredictedStep],
    start: int,
    samples: Sequence[SequenceSample],
) -> float:
    """Largest distance of a kernel from its rest position over all members and steps [diagonals of its scene].

    Raises:
        DivergenceError: a position is not finite; names the step and the sequence.
    """
    largest = 0.0
    with torch.no_grad():
        distance = torch.stack([(step.positions - batch.rest).norm(dim=-1) for step in steps])
        table = torch.stack([distance[:, m.kernels].amax(1) for m in batch.members], 1).tolist()
    for t, row in enumerate(table):
        for value, sample in zip(row, samples, strict=True):
            if not value < float("inf"):
                raise DivergenceError(describe(start + t, samples, sample, f"positions are {value}"))
            largest = max(largest, value / diagonals[sample.scene_id])
    return largest


def describe(step: int | None, samples: Sequence[SequenceSample], sample: SequenceSample | None, what: str) -> str:
    """The message of a divergence: where, in which sequence and what broke."""
    name = f"{sample.object_name}/{sample.sequence_name}" if sample is not None else ", ".join(
        f"{s.object_name}/{s.sequence_name}" for s in samples
    )  # fmt: skip
    where = f"predicted step {step + 1} of {samples[0].steps}, " if step is not None else ""
    return (
        f"training diverged at {where}sequence {name}: {what}. Lower optimizer.network_lr or optimizer.initial_lr, or "
        "let the curriculum grow more slowly; the last checkpoint is from before this step."
    )
