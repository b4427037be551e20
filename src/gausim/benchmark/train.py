"""Training: sequence-steps per second of whole optimiser steps, what takes the time and what the graph holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from gausim.benchmark.harness import Options, Row, medians, peak_resident, torch_threads
from gausim.core import Rendered, Renderer
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.kernels.operations import OPERATIONS, plain_forms
from gausim.render.reference import ReferenceRenderer
from gausim.training.module import GausSimModule
from gausim.training.rollout import States, windows
from gausim.training.supervision.comparison import Comparison

# Timed calls of what serves as reference only and takes long.
REFERENCE_ROUNDS = 2


class _Kept:
    """A tensor that the graph holds; says so when the graph lets go of it."""

    def __init__(self, tensor: Tensor, ledger: _Ledger) -> None:
        # Detached: an operation that saves its own result would hold itself for ever.
        self.tensor, self._ledger = tensor.detach(), ledger
        storage = tensor.untyped_storage()
        self._key = storage.data_ptr()
        ledger.add(self._key, storage.nbytes())

    def __del__(self) -> None:
        self._ledger.drop(self._key)


class _Ledger:
    """Bytes of the distinct storages that are held, and the most there were at one time."""

    def __init__(self) -> None:
        self.now = self.peak = 0
        self._held: dict[int, list[int]] = {}

    def add(self, key: int, size: int) -> None:
        entry = self._held.setdefault(key, [0, size])
        if entry[0] == 0:
            self.now += size
            self.peak = max(self.peak, self.now)
        entry[0] += 1

    def drop(self, key: int) -> None:
        entry = self._held[key]
        entry[0] -= 1
        if entry[0] == 0:
            self.now -= entry[1]
            del self._held[key]


def peak_saved_bytes(call: Callable[[], object]) -> int:
    """The most bytes of distinct storages that autograd keeps at one time while ``call`` runs.

    Unlike :func:`gausim.benchmark.harness.saved_bytes` it lets go of what a backward pass inside ``call`` frees.
    """
    ledger = _Ledger()
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: _Kept(tensor, ledger), lambda kept: kept.tensor):
        call()
    return ledger.peak


class _Recorder:
    """A renderer that keeps what it was asked to draw."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.calls = renderer, list[tuple[tuple[Any, ...], dict[str, Any]]]()

    def __call__(self, *args: Any, **options: Any) -> Rendered:
        kept = tuple(a.detach().clone().requires_grad_(a.requires_grad) if isinstance(a, Tensor) else a for a in args)
        self.calls.append((kept, options))
        return self.renderer(*args, **options)

    def replay(self, renderer: Renderer, calls: int | None = None) -> None:
        """Draws the first ``calls`` again (all when None), forwards and backwards."""
        for args, options in self.calls[:calls]:
            drawn = renderer(*args, **options).rgb
            if drawn.requires_grad:
                torch.autograd.grad(drawn.sum(), [a for a in args if isinstance(a, Tensor) and a.requires_grad])


@dataclass
class _Case:
    """A module with a batch and an optimiser that learns nothing, so that every step is the same work."""

    module: GausSimModule
    samples: list[SequenceSample]
    optimizer: Optimizer

    @staticmethod
    def of(module: GausSimModule, datamodule: ReadyDataModule, options: Options, sequences: int, steps: int) -> _Case:
        index = datamodule.index
        chosen = range(min(sequences, len(index)))
        views = [index.objects[index.entries[i][0]].train_views for i in chosen]
        samples = [index.sample(i, range(steps + 1), v).to(options.device) for i, v in zip(chosen, views, strict=True)]
        module.to(options.device)
        module.train()
        module.fraction_every = 0  # the share is measured in every fiftieth step
        optimizer = module.configure_optimizers()
        for group in optimizer.param_groups:
            group["lr"] = 0.0
        return _Case(module, samples, optimizer)

    @property
    def steps(self) -> int:
        return self.samples[0].steps

    @property
    def states(self) -> int:
        """Sequence-steps of one optimiser step."""
        return self.steps * len(self.samples)

    def shortened(self, steps: int) -> _Case:
        samples = [replace(s, frames=s.frames[: steps + 1]) for s in self.samples]
        return _Case(self.module, samples, self.optimizer)

    def step(self, *, static: bool) -> None:
        """One optimiser step with or without the static loss, which only some batches carry."""
        own = self.module.objective
        self.module.objective = replace(own, static_probability=1.0 if static and own.static_weight else 0.0)
        try:
            self.module.optimise(self.samples, self.optimizer, torch.Generator().manual_seed(0))
        finally:
            self.module.objective = own

    def descend(self) -> None:
        """Clipping, optimiser and average of the weights, on the gradients that are there."""
        self.module.settings.clip(self.optimizer)
        self.optimizer.step()
        self.module.average.update(self.module.named_parameters())

    def rollout(self) -> Iterator[tuple[int, States, Tensor]]:
        """The stretches of the rollout: frames before it, states, momentum losses."""
        module = self.module
        batch = module.simulator.batch([s.scene_id for s in self.samples])
        length, checkpoint = module.objective.window(self.steps), module.objective.checkpoint_steps
        initial = module.initial(self.samples, batch)
        for start, made in windows(module.simulator, batch, initial, self.steps, length, checkpoint=checkpoint):
            yield start, States.of(made), torch.stack([step.momentum for step in made])

    def dynamics(self) -> None:
        """The rollout, forwards and backwards."""
        for _, states, momentum in self.rollout():
            total = sum(x.sum() for x in (*states.tensors(), momentum))
            if isinstance(total, Tensor) and total.requires_grad:
                total.backward()

    def comparison(self) -> Comparison:
        batch = self.module.simulator.batch([s.scene_id for s in self.samples])
        return self.module.images.comparison(self.samples, batch)

    def stretches(self) -> list[tuple[int, States]]:
        """The states of the rollout, cut off from it."""
        kept = []
        for start, states, _ in self.rollout():
            kept.append((start, States(*(x.detach().requires_grad_(x.requires_grad) for x in states.tensors()))))
        return kept


@contextmanager
def _recorded(case: _Case) -> Iterator[tuple[_Recorder, list[tuple[Tensor, Tensor]]]]:
    """Keeps what is drawn and what is compared within a block."""
    module, loss = case.module, case.module.objective.image
    recorder, compared = _Recorder(module.renderer), list[tuple[Tensor, Tensor]]()
    inner = loss.value_and_gradient

    def compare(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        compared.append((prediction.clone(), target.clone()))
        return inner(prediction, target)

    module.images.renderer, loss.value_and_gradient = recorder, compare  # type: ignore[method-assign]
    try:
        yield recorder, compared
    finally:
        module.images.renderer = recorder.renderer
        del loss.value_and_gradient


def run(
    options: Options,
    module: GausSimModule,
    datamodule: ReadyDataModule,
    *,
    sequences: int = 4,
    steps: int | None = None,
) -> list[Row]:
    """Times optimiser steps and their parts, and counts what the graph holds.

    Args:
        options: how.
        module: what is trained; its weights do not change, its running statistics do.
        datamodule: where sequences come from.
        sequences: per optimiser step, at most as many as there are.
        steps: predicted frames T; the curriculum's largest when None (three in a quick run).
    """
    datamodule.setup("fit")
    length = steps or (min(3, datamodule.curriculum.t_max) if options.quick else datamodule.curriculum.t_max)
    with torch_threads(options.threads):
        case = _Case.of(module, datamodule, options, sequences, length)
        cameras = case.samples[0].cameras
        name = (
            f"{case.samples[0].object_name}: {len(case.samples)} sequences x {len(cameras.names)} views x "
            f"{cameras.width}x{cameras.height}, T={case.steps}"
        )
        return [*_speed(name, case, options), *_memory(name, case, options)]


def _speed(name: str, case: _Case, options: Options) -> list[Row]:
    stretches = case.stretches()
    with _recorded(case) as (recorder, compared):
        compare_all(case, stretches)
    loss = case.module.objective.image.value_and_gradient
    times = medians(
        {
            "without": lambda: case.step(static=False),
            "with": lambda: case.step(static=True),
            "dynamics": case.dynamics,
            "compared": lambda: compare_all(case, stretches),
            "render": lambda: recorder.replay(recorder.renderer),
            "loss": lambda: [loss(*pair) for pair in compared],
            "descend": case.descend,
        },
        options,
    )
    static = case.module.objective.static_chance(case.steps) * max(0.0, times["with"] - times["without"])
    whole = times["without"] + static
    parts = {
        "dynamics, forwards and backwards": times["dynamics"],
        "renderer, forwards and backwards": times["render"],
        "image loss with its gradient": times["loss"],
        "drawing around the renderer (colours, covariances, true frames, motion)": (
            times["compared"] - times["render"] - times["loss"]
        ),
        "static loss (its share of the batches)": static,
        "clipping, optimiser, average": times["descend"],
    }
    parts["rest"] = whole - sum(parts.values())
    rows = [
        Row(name, "throughput", case.states / whole, "sequence-steps/s"),
        Row(name, "optimiser step", 1e3 * whole, "ms"),
    ]
    rows += [Row(name, part, value / whole, "1", "of the optimiser step; timed alone") for part, value in parts.items()]
    return rows + _ratios(name, case, options, recorder, whole - times["without"], times["render"])


def compare_all(case: _Case, stretches: list[tuple[int, States]]) -> None:
    """Draws and compares a whole rollout, down to the gradients with respect to the states."""
    comparison = case.comparison()
    for start, states in stretches:
        losses, _ = comparison(states, start)
        wanted = [x for x in states.tensors() if x.requires_grad]
        if wanted:
            torch.autograd.grad(losses.sum(), wanted)


def _ratios(name: str, case: _Case, options: Options, recorder: _Recorder, static: float, render: float) -> list[Row]:
    """How much longer the same step takes with plain parts."""

    def step(names: Sequence[str]) -> None:
        with plain_forms(names):
            case.step(static=False)

    reference, drawn = ReferenceRenderer(), recorder.calls[0][0][0].shape[0]
    forms: dict[str, Callable[[], object]] = {n: partial(step, [n]) for n in OPERATIONS}
    times = medians({"own": partial(step, []), "plain": partial(step, list(OPERATIONS)), **forms}, options)
    drawing = medians(
        {"reference": lambda: recorder.replay(reference, calls=1)},
        options,
        rounds=min(REFERENCE_ROUNDS, options.rounds),
    )
    whole = times["own"] + static
    plain = times["plain"] + static
    scaled = plain - render + drawing["reference"] * case.states / drawn
    text = f"that and the plain torch renderer (timed on {drawn} of {case.states} states, scaled)"
    return [
        *(
            Row(name, f"speed-up by {n}", (times[n] + static) / whole, "x", "its fast form against the plain")
            for n in forms
        ),
        Row(name, "speed-up", plain / whole, "x", "the same step with every operation but the renderer as plain torch"),
        Row(name, "speed-up", scaled / whole, "x", text),
    ]


def _memory(name: str, case: _Case, options: Options) -> list[Row]:
    held = peak_saved_bytes(lambda: case.step(static=False))
    rows = [Row(name, "held for the backward pass, at most", held / 2**20, "MiB")]
    if case.steps > 1:
        fewer = case.steps // 2
        shorter = peak_saved_bytes(lambda: case.shortened(fewer).step(static=False))
        grown = (held - shorter) / (case.steps - fewer) / 2**20
        rows.append(Row(name, "held for each further predicted frame", grown, "MiB"))
    if options.device.type == "cuda":
        rows.append(Row(name, "device memory, at most", torch.cuda.max_memory_allocated(options.device) / 2**20, "MiB"))
    return [*rows, Row(name, "process memory, at most", peak_resident() / 2**20, "MiB")]
