"""A step of one batch as a CUDA graph: thousands of CUDA kernels in one launch."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, Frame, SimState

WARM_UP = 3  # steps before a capture: lazy initialisation and autotuning must be over (PyTorch's notes on CUDA graphs)


StepFunction = Callable[[SimState, Tensor | None], Frame]


def not_captured(what: str, error: RuntimeError) -> ConfigError:
    """The error of a step or rollout that a CUDA graph cannot capture."""
    return ConfigError(
        f"model.simulator.rollout.cuda_graph: the {what} cannot be captured "
        f"({str(error).splitlines()[0]}). Something in it waits for the device "
        "or has a shape that depends on values; set it to false."
    )


class GraphedStep:
    """A step without loss gradients, captured at its first call and replayed at later ones.

    Inputs are copied into fixed buffers and results out of them, so that a call is equivalent to the step. Steps with
    and without forces are captured separately. Other data that the step reads (weights, constants of the batch,
    evaluation mode, autocast) is read at its address during the capture: it may change in place, but not be
    reallocated. Make a new instance for every rollout; the capture costs about four steps.
    """

    def __init__(self, step: StepFunction, rest: Float[Tensor, "K 3"]) -> None:
        """Allocates the buffers.

        Args:
            step: from state and forces to the next frame; its shapes and branches must not depend on values.
            rest: rest positions of all kernels; the state has their shape, type and CUDA device.
        """
        self._step = step
        self._state = SimState(torch.zeros_like(rest), torch.zeros_like(rest))
        self._force = torch.zeros_like(rest)
        self._graphs: dict[bool, tuple[torch.cuda.CUDAGraph, Frame]] = {}

    @torch.no_grad()
    def __call__(self, state: SimState, force: Float[Tensor, "K 3"] | None = None) -> Frame:
        """The next frame, in newly allocated tensors.

        Raises:
            ConfigError: the step cannot be captured, because one of its operations waits for the device.
        """
        self._state.positions.copy_(state.positions)
        self._state.previous.copy_(state.previous)
        pushed = force is not None
        if force is not None:
            self._force.copy_(force)
        if pushed not in self._graphs:
            self._graphs[pushed] = self._record(pushed)
        graph, frame = self._graphs[pushed]
        graph.replay()
        return Frame(frame.positions.clone(), frame.deformation_gradients.clone(), frame.rotations.clone())

    def _record(self, pushed: bool) -> tuple[torch.cuda.CUDAGraph, Frame]:
        force = self._force if pushed else None
        device = self._force.device
        aside = torch.cuda.Stream(device)
        aside.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(aside):
            for _ in range(WARM_UP):
                self._step(self._state, force)
        torch.cuda.current_stream(device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        try:
            # thread_local: the pin-memory thread of a data loader may call CUDA during the capture.
            with torch.cuda.device(device), torch.cuda.graph(graph, capture_error_mode="thread_local"):
                result = self._step(self._state, force)
        except RuntimeError as error:
            raise not_captured("step", error) from error
        return graph, result
