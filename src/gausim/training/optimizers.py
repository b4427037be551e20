"""Settings of the optimiser: learning rates by parameter group, schedules, clipping."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from gausim.core import ConfigError

GROUPS = ("network", "scene", "template", "matrices", "initial")


@runtime_checkable
class Schedule(Protocol):
    """Learning-rate schedule of a run."""

    def factor(self, epoch: float, epochs: int) -> float:
        """Factor on the learning rates at ``epoch`` (with its fraction) of ``epochs``."""


@dataclass(frozen=True)
class HalvingSchedule:
    """Schedule that halves the rates after ``first`` epochs and then every ``every`` epochs (METHOD section 4)."""

    first: int = 16
    every: int = 2

    def factor(self, epoch: float, epochs: int) -> float:
        """A power of one half."""
        done = math.floor(epoch)
        return 1.0 if done < self.first else 0.5 ** (1 + (done - self.first) // self.every)


@dataclass(frozen=True)
class StableDecaySchedule:
    """Schedule of a linear warm-up, constant rates, and a half-cosine decay over the final part of the run.

    An early end moves the final part forward, so no training is repeated. With ``decay`` 1 the rates decay over the
    whole run, whose length is then fixed. The warm-up takes ``warmup`` epochs, the decay a fraction ``decay`` of the
    run, down to the factor ``final``.
    """

    warmup: float = 1.0
    decay: float = 1 / 3
    final: float = 0.05

    def __post_init__(self) -> None:
        if self.warmup < 0 or not 0 < self.decay <= 1 or not 0 <= self.final <= 1:
            raise ConfigError(
                f"optimizer.schedule: expected warmup >= 0, 0 < decay <= 1 and final in [0, 1], got {self}."
            )

    def factor(self, epoch: float, epochs: int) -> float:
        """A factor between ``final`` and 1 (less during the warm-up)."""
        if epoch < self.warmup:
            return max(0.05, epoch / self.warmup)
        fraction = (min(1.0, epoch / max(1, epochs)) - 1 + self.decay) / self.decay
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * max(0.0, fraction)))


@dataclass(frozen=True)
class ExponentialSchedule:
    """Schedule of exponential decay down to the factor ``final`` at the end."""

    final: float = 0.1

    def factor(self, epoch: float, epochs: int) -> float:
        """Between ``final`` and 1."""
        return float(self.final ** min(1.0, epoch / max(1, epochs)))


@dataclass(frozen=True)
class LinearSchedule:
    """Schedule of linear decay down to the factor ``final`` at the end."""

    final: float = 0.0

    def factor(self, epoch: float, epochs: int) -> float:
        """Between ``final`` and 1."""
        return 1.0 + (self.final - 1.0) * min(1.0, epoch / max(1, epochs))


@dataclass(frozen=True)
class OptimizerSettings:
    """Optimiser and learning rates; ``conf/optimizer/default.yaml`` and ``conf/base/more.yaml`` explain the settings.

    ``decay`` is the weight decay by group, of matrices and of all initial states: parameters that the data hardly
    determine return to zero, where Adam alone would let them drift. Weights common to all scenes are trained from the
    fraction ``shared_from`` of the run on; before, only parameters of scenes and initial states are. The default
    ``optimizer`` is Adam; without a ``schedule`` the rates are constant.
    """

    optimizer: Callable[..., Optimizer] | None = None
    network_lr: float = 8e-4
    scene_lr: float = 8e-4
    template_lr: float | None = None
    matrices_lr: float | None = None
    initial_lr: float = 8e-4
    schedule: Schedule | None = None
    clip_norm: float = 1.0
    clip_per_group: bool = False
    decay: Mapping[str, float] = field(default_factory=dict)
    ema_decay: float = 0.0
    shared_from: float = 0.0

    def __post_init__(self) -> None:
        if min(self.network_lr, self.scene_lr, self.template_lr or 0.0, self.initial_lr, self.clip_norm) < 0 or not (
            0 <= self.ema_decay < 1 and 0 <= self.shared_from < 1
        ):
            raise ConfigError(
                f"optimizer: expected rates and clip_norm >= 0, ema_decay and shared_from in [0, 1), got {self}."
            )
        wrong = [name for name, value in self.decay.items() if name not in GROUPS or not value >= 0]
        if wrong:
            raise ConfigError(f"optimizer.decay: expected values >= 0 for some of {', '.join(GROUPS)}, got {wrong}.")

    def build(self, groups: Mapping[str, Sequence[Parameter]]) -> Optimizer:
        """The optimiser over the named groups of :data:`GROUPS`.

        A parameter that a batch does not use has no loss gradient, and the optimiser skips it and its momentum.
        """
        template = self.scene_lr if self.template_lr is None else self.template_lr
        matrices = template if self.matrices_lr is None else self.matrices_lr
        rates = dict(zip(GROUPS, (self.network_lr, self.scene_lr, template, matrices, self.initial_lr), strict=True))
        made: list[dict[str, Any]] = []
        for name, members in groups.items():
            parts: dict[float, list[Parameter]] = {0.0: []}  # parameters without decay come first
            for p in members:
                decay = self.decay.get(name, 0.0) if p.ndim >= 2 or name == "initial" else 0.0
                parts.setdefault(decay, []).append(p)
            for decay, part in parts.items():
                own = {"weight_decay": decay} if self.decay else {}
                if part:
                    made.append({"params": part, "lr": rates[name], "base_lr": rates[name], "name": name, **own})
        return (self.optimizer or Adam)(made)

    def set_rates(self, optimizer: Optimizer, epoch: float, epochs: int, shared: Collection[str] = ()) -> float:
        """Sets the learning rates of all groups; returns the schedule's factor.

        Those of the ``shared`` groups are zero before ``shared_from``.
        """
        factor = self.schedule.factor(epoch, epochs) if self.schedule is not None else 1.0
        waiting = shared if epoch < self.shared_from * epochs else ()
        for group in optimizer.param_groups:
            group["lr"] = 0.0 if group["name"] in waiting else group["base_lr"] * factor
        return factor

    def clip(self, optimizer: Optimizer) -> dict[str, Tensor]:
        """Clips the loss gradients; returns the norm of each named group before clipping."""
        grads: dict[str, list[Tensor]] = {}
        for group in optimizer.param_groups:
            grads.setdefault(group["name"], []).extend(p.grad for p in group["params"] if p.grad is not None)
        device = optimizer.param_groups[0]["params"][0].device  # a zero on the host would block
        zero = torch.zeros((), device=device)
        norms = {name: torch.nn.utils.get_total_norm(g) if g else zero for name, g in grads.items()}
        if self.clip_norm > 0:
            total = torch.stack([n.to(zero) for n in norms.values()]).norm()
            for name, own in grads.items():
                if own:
                    norm = norms[name] if self.clip_per_group else total
                    torch._foreach_mul_(own, (self.clip_norm / (norm + 1e-6)).clamp(max=1.0))
        return norms
