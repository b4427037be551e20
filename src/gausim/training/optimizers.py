"""Settings of the optimiser: learning rates by parameter group, weight decay, clipping."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import AdamW, Optimizer

from gausim.core import ConfigError

GROUPS = ("network", "scene", "template", "matrices", "initial")


@dataclass(frozen=True)
class OptimizerSettings:
    """Optimiser and learning rates by parameter group.

    Attributes:
        optimizer: the optimiser as a function of its parameter groups; None: AdamW.
        network_lr: learning rate of the graph network.
        scene_lr: that of densities and attributes.
        template_lr: that of the decoders of material.
        initial_lr: that of initial states [diagonals per show].
        clip_norm: norm to which loss gradients are clipped; 0: not at all.
        clip_per_group: clip each group separately.
        decay: weight decay by group, of matrices and of all initial states: parameters that the data hardly determine
            return to zero, where Adam alone would let them drift.
    """

    optimizer: Callable[..., Optimizer] | None = None
    network_lr: float = 1e-3
    scene_lr: float = 0.1
    template_lr: float = 5e-3
    initial_lr: float = 2e-3
    clip_norm: float = 1.0
    clip_per_group: bool = True
    decay: Mapping[str, float] = field(default_factory=lambda: {"network": 5.0})

    def __post_init__(self) -> None:
        if min(self.network_lr, self.scene_lr, self.template_lr, self.initial_lr, self.clip_norm) < 0:
            raise ConfigError(f"optimizer: expected rates and clip_norm >= 0, got {self}.")
        wrong = [name for name, value in self.decay.items() if name not in GROUPS or not value >= 0]
        if wrong:
            raise ConfigError(f"optimizer.decay: expected values >= 0 for some of {', '.join(GROUPS)}, got {wrong}.")

    def build(self, groups: Mapping[str, Sequence[Parameter]]) -> Optimizer:
        """The optimiser over the named groups of :data:`GROUPS`.

        A parameter that a batch does not use has no loss gradient, and the optimiser skips it and its momentum.
        """
        values = (self.network_lr, self.scene_lr, self.template_lr, self.template_lr, self.initial_lr)
        rates = dict(zip(GROUPS, values, strict=True))
        made: list[dict[str, Any]] = []
        for name, members in groups.items():
            parts: dict[float, list[Parameter]] = {0.0: []}  # parameters without decay come first
            for p in members:
                decay = self.decay.get(name, 0.0) if p.ndim >= 2 or name == "initial" else 0.0
                parts.setdefault(decay, []).append(p)
            for decay, part in parts.items():
                own = {"lr": rates[name], "base_lr": rates[name], "name": name, "weight_decay": decay}
                if part:
                    made.append({"params": part, **own})
        return (self.optimizer or AdamW)(made)

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


def set_rates(optimizer: Optimizer, factor: Callable[[str], float]) -> None:
    """Sets the learning rates of an optimiser that :meth:`OptimizerSettings.build` made; ``factor`` is by group."""
    for group in optimizer.param_groups:
        group["lr"] = group["base_lr"] * factor(group["name"])
