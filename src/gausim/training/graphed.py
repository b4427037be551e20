"""Rollouts of optimiser steps as CUDA graphs: tens of thousands of CUDA kernels in two launches."""

import gc
from collections.abc import Callable, Iterator
from typing import Any, cast

import torch
from torch import Tensor, nn

from gausim.core import Frame, SimState
from gausim.models.rollout.cuda_graph import not_captured
from gausim.models.step.simulator import GausSim
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import States, after, windows

# Frames of a rollout, tensor by tensor, from its two initial positions.
Replay = Callable[..., tuple[Tensor, ...]]


class _Stretch(nn.Module):
    """T steps of a batch, from tensors to tensors."""

    def __init__(self, model: nn.Module, batch: SceneBatch, steps: int) -> None:
        super().__init__()
        self.model, self._batch, self._steps = model, batch, steps

    def forward(self, positions: Tensor, previous: Tensor) -> tuple[Tensor, ...]:
        """Positions, deformation gradients, rotations and momentum losses of the T frames."""
        model, state = cast(Any, self.model), SimState(positions, previous)
        ((_, made),) = windows(model, self._batch, state, self._steps, self._steps)
        return (*States.of(made), torch.stack([step.momentum for step in made]))


class GraphedRollouts:
    """Rollouts of one simulator, captured with their backward pass at the first call and replayed at later ones.

    A capture holds for one number of sequences, of steps and one choice of trained
    parameters; the last one of each number of sequences is kept. Parameters and input statistics are read and written
    at their addresses: they may change in place only. Each rollout is followed by at most one backward pass, before the
    next rollout of its kind.
    """

    def __init__(self, model: nn.Module) -> None:
        self._model = model
        self._kept: dict[object, tuple[object, Replay]] = {}  # what it holds for, and the capture

    @property
    def serves(self) -> bool:
        """Whether rollouts can be captured, and are to be: of one scene in fixed pins, with the edges at rest."""
        model = self._model
        return (
            isinstance(model, GausSim) and model.rollout.cuda_graph and model.log_density[0].device.type == "cuda"
            and not model.history
            and len(model.scenes) == 1 and model.scenes[0].surroundings.still and model.predictor.edges == "rest"
        )  # fmt: skip

    def windows(
        self, batch: SceneBatch, initial: SimState, steps: int, length: int
    ) -> Iterator[tuple[int, list[Frame]]]:
        """As :func:`gausim.training.rollout.windows`, by replays where they serve.

        Raises:
            ConfigError: the rollout cannot be captured, because one of its operations waits for the device.
        """
        if not self.serves or steps % length:
            yield from windows(cast(Any, self._model), batch, initial, steps, length)
            return
        state = initial
        for start in range(0, steps, length):
            state = state.detach() if start else state
            made = self._replayed(batch, state, length)
            state = after(made, state)
            yield start, made

    def _replayed(self, batch: SceneBatch, initial: SimState, steps: int) -> list[Frame]:
        given, parameters = (initial.positions, initial.previous), list(self._model.parameters())
        kind, trained = len(batch.members), tuple(x.requires_grad for x in (*given, *parameters))
        if self._kept.get(kind, ((), None))[0] != (steps, trained):
            self._kept.pop(kind, None)  # frees its memory before the next one takes as much
            stretch = _Stretch(self._model, batch, steps)
            self._kept[kind] = (steps, trained), self._capture(stretch, initial)
        for parameter in parameters:  # or autograd would adopt the buffer of the capture, which is overwritten
            if parameter.requires_grad and parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        made = [x.clone() for x in self._kept[kind][1](*given)]  # the next replay overwrites what the capture returns
        return [Frame(x, gradients, q, momentum=m) for x, gradients, q, m in zip(*made, strict=True)]

    def _capture(self, stretch: _Stretch, initial: SimState) -> Replay:
        given = tuple(x.detach().clone().requires_grad_(x.requires_grad) for x in (initial.positions, initial.previous))
        kept = [buffer.clone() for buffer in self._model.buffers()]  # rollouts before the capture are not to count
        gc.collect()  # during a capture no earlier one may be freed
        gc.disable()
        try:
            with torch.enable_grad():
                made: Any = torch.cuda.make_graphed_callables(stretch, given, allow_unused_input=True)
        except RuntimeError as error:
            raise not_captured("rollout", error) from error
        finally:
            gc.enable()
        with torch.no_grad():
            for buffer, value in zip(self._model.buffers(), kept, strict=True):
                buffer.copy_(value)
        return cast(Replay, made)
