"""What the graph of a training step holds, and what the host waits for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from helpers import sway
from helpers.sway import blobs, sample, sway_module
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.harness import peak_saved_bytes
from gausim.losses import Objective
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings
from gausim.training.supervision import comparison


def real_module(objective: Objective) -> GausSimModule:
    parts = {"renderer": blobs, "objective": objective, "fraction_every": 0}
    return sway.real_module(edges="rest", layers=2, output_scale=0.1, parts=parts)


def optimise(module: GausSimModule, steps: int = 3, times: int = 1) -> dict[str, float]:
    optimizer = module.configure_optimizers()
    stats: dict[str, float] = {}
    for number in range(times):
        stats = module.optimise([sample(0, steps=steps)], optimizer, torch.Generator().manual_seed(number))
    return stats


def parameters(module: torch.nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


@pytest.fixture
def one_state_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CPU_PIXELS", 1)


def held(objective: Objective, steps: int) -> int:
    return peak_saved_bytes(lambda: optimise(real_module(objective), steps))


def test_memory_does_not_grow_with_the_rollout_where_gradients_stop(one_state_at_once: None) -> None:
    stopped = Objective(backprop_steps=1, static_weight=0.0)
    assert held(stopped, 8) == held(stopped, 3) > 0
    whole = Objective(backprop_steps=0, static_weight=0.0)
    assert held(whole, 12) > 2 * held(whole, 3)


def test_checkpointing_the_steps_keeps_the_gradients_and_the_statistics() -> None:
    whole, kept = (real_module(Objective(backprop_steps=0, checkpoint_steps=c)) for c in (False, True))
    first, second = optimise(whole, steps=4), optimise(kept, steps=4)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert second[name] == pytest.approx(value, rel=1e-5, abs=1e-9), name
    for (name, a), (_, b) in zip(whole.named_parameters(), kept.named_parameters(), strict=True):
        assert (a.grad is None) == (b.grad is None), name
        if a.grad is not None:
            torch.testing.assert_close(b.grad, a.grad, rtol=1e-3, atol=1e-5 * float(a.grad.abs().max()))
    after = parameters(kept)
    for name, value in parameters(whole).items():
        if "normaliser" in name:
            torch.testing.assert_close(after[name], value, rtol=1e-6, atol=1e-9)
    # The first statistics, one step of the static loss and four of the rollout on two levels, each counted once.
    carried, units = "loss_static" in first, sum(level.count for level in kept.model.batch([0]).levels)
    assert int(kept.model.predictor.node_normaliser.count) == units * (1 + 4 + carried)


def test_checkpointing_the_steps_makes_the_graph_small(one_state_at_once: None) -> None:
    def grown(*, checkpoint: bool) -> int:
        objective = Objective(backprop_steps=0, static_weight=0.0, checkpoint_steps=checkpoint)
        return held(objective, 8) - held(objective, 4)

    assert 0 <= grown(checkpoint=True) < 0.1 * grown(checkpoint=False)


# ------------------------------------------------------------------------------------------------ reads put off


def pair(objective: Objective, drift: float) -> tuple[GausSimModule, GausSimModule]:
    """The same module twice; the second one puts its reads off as on a GPU."""
    made = [sway_module(objective, network_lr=1e-2, scene_lr=1e-2, initial_lr=1e-2) for _ in range(2)]
    for module in made:
        with torch.no_grad():
            module.model.drift[0] += drift
    made[1].defers = lambda device: True  # type: ignore[method-assign]
    return made[0], made[1]


@pytest.mark.parametrize(("backprop_steps", "drift"), [(0, 0.02), (1, 0.02), (1, 0.2), (2, 0.2), (0, 5.0), (1, 5.0)])
def test_reads_put_off_change_nothing(backprop_steps: int, drift: float) -> None:
    now, later = pair(Objective(backprop_steps=backprop_steps, explosion=0.6, static_weight=0.0), drift)
    stats = [optimise(module, steps=6) for module in (now, later)]
    assert stats[0].keys() == stats[1].keys() and stats[0]["exploded"] == float(drift > 0.1)
    assert ("loss_image" in stats[0]) == (drift < 1)  # of the middle one a few frames are learned from
    for name, value in stats[0].items():
        assert stats[1][name] == pytest.approx(value, rel=1e-5, abs=1e-12), name
    for name, value in parameters(now).items():
        torch.testing.assert_close(parameters(later)[name], value, rtol=1e-5, atol=1e-8)


class Reads(TorchDispatchMode):
    """Counts operations that bring a number to the host."""

    NAMES = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "unique")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if any(func.overloadpacket.__name__.startswith(name) for name in self.NAMES):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


@contextmanager
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    with Reads() as reads, monkeypatch.context() as patch:
        for name in ("tolist", "cpu", "numpy", "item"):
            inner = getattr(Tensor, name)
            patch.setattr(Tensor, name, lambda *a, n=name, f=inner, **k: (reads.found.append(n), f(*a, **k))[1])
        yield reads.found


@pytest.mark.parametrize("backprop_steps", [1, 0])
def test_one_read_per_optimiser_step(backprop_steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from gausim.kernels.operations import plain_forms

    _, module = pair(Objective(backprop_steps=backprop_steps), 0.01)
    module.images.renderer = blobs
    module.settings = OptimizerSettings(optimizer=torch.optim.SGD)  # Adam counts steps on the host
    optimizer, batch = module.configure_optimizers(), [sample(0), sample(1)]
    module.optimise(batch, optimizer, torch.Generator().manual_seed(0))  # cameras and baselines are read once
    draws = torch.Generator().manual_seed(1)
    monkeypatch.setattr(module.method, "terms", lambda: ())  # whether to is drawn on the host, and never leaves it
    with plain_forms(), watched(monkeypatch) as found:
        module.optimise(batch, optimizer, draws)
    assert found == ["tolist"]


@pytest.mark.gpu
@pytest.mark.parametrize("backprop_steps", [1, 0])
def test_the_device_is_not_waited_for(backprop_steps: int) -> None:
    module = sway_module(Objective(backprop_steps=backprop_steps, static_weight=0.0)).cuda()
    module.model.scenes = [scene.to("cuda") for scene in module.model.scenes]
    module.images.renderer = blobs
    samples, optimizer = [sample(0).to("cuda"), sample(1).to("cuda")], module.configure_optimizers()
    draws, facts = torch.Generator().manual_seed(0), [s.facts for s in samples]
    module.optimise(samples, optimizer, draws)
    torch.cuda.set_sync_debug_mode("error")
    try:
        optimizer.zero_grad(set_to_none=True)
        statistics = module.roll_out(samples, facts, draws)
        norms = module.settings.clip(optimizer)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(statistics.fetch(norms).lasting(facts, 3.0).frames) == 3
